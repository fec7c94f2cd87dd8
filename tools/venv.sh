#!/bin/sh
# Prepares .venv with the project and its development tools; `make setup` calls it when it has to.
# Environment: PYTHON, the interpreter to build from (python3).
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}

fail() {
    echo "make setup: $*" >&2
    exit 2
}

command -v "$python" >/dev/null || fail "there is no '$python' here; name a Python: make setup PYTHON=/path/to/python3"
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])') || fail "'$python' does not run"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    fail "'$python' is Python $version, but 3.11 or newer is needed; name one: make setup PYTHON=python3.11"

if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
    if ! "$python" -c 'import ensurepip, venv; ensurepip.version()' 2>/dev/null; then
        package=python3-venv
        [ "$version" = "$(/usr/bin/python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)" ] ||
            package=python$version-venv
        sh tools/apt.sh "make setup" "$package" || exit 2
        "$python" -c 'import ensurepip, venv; ensurepip.version()' || fail "'$python' still has no venv after installing $package"
    fi
    echo "make setup: making .venv with Python $version (once; needs the package index)"
    "$python" -m venv --clear .venv || fail "'$python -m venv .venv' failed"
fi

export PIP_DISABLE_PIP_VERSION_CHECK=1
pip() { .venv/bin/python -m pip --quiet --no-input "$@" || fail "pip failed; its own message is above"; }
pip install --upgrade 'pip>=25.1'
pip install --editable . --group dev
touch .venv/.stamp-dev
