#!/bin/sh
# Prepares .venv with the project; `make` calls it when it has to.
# Usage: tools/venv.sh run    what the appliance and the demos need
#        tools/venv.sh dev    and what tests and checks need
# Environment: PYTHON, the interpreter to build from (python3).
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
kind=${1:-dev}

fail() {
    echo "make: $*" >&2
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
        sh tools/apt.sh "make" "$package" || exit 2
        "$python" -c 'import ensurepip, venv; ensurepip.version()' || fail "'$python' still has no venv after installing $package"
    fi
    echo "make: preparing .venv with Python $version (once; needs the package index)"
    "$python" -m venv --clear .venv || fail "'$python -m venv .venv' failed"
fi

export PIP_DISABLE_PIP_VERSION_CHECK=1
# A terminal sees pip's own progress; a log gets one line a step.
quiet=--quiet
[ -t 1 ] && quiet=
pip() { .venv/bin/python -m pip $quiet --no-input "$@" || fail "pip failed; its own message is above"; }

case $kind in
run)
    echo "make: installing the appliance and the packages that it needs into .venv"
    pip install --editable '.[web]'
    ;;
dev)
    echo "make: installing the appliance, and the tools for tests and checks (about 200 MB), into .venv"
    pip install --upgrade 'pip>=25.1'
    pip install --editable . --group dev
    touch .venv/.stamp-dev
    ;;
*) fail "venv.sh takes run or dev, not '$kind'" ;;
esac
touch .venv/.stamp-run
