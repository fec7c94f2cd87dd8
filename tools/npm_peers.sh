#!/bin/sh
# Installs the npm packages that tests run as peers, from tests/peers/package.json, unless they are there.
# Usage: tools/npm_peers.sh      Exit status 1 when they are still missing; their tests are then skipped.
set -eu
tools=$(cd "$(dirname "$0")" && pwd)
cd "$tools/../tests/peers"
stamp=node_modules/.stamp
[ -e "$stamp" ] && [ ! package.json -nt "$stamp" ] && exit 0

fail() {
    rm -rf node_modules  # half of them would fail tests
    echo "make test: tests with npm packages are skipped: $*" >&2
    exit 1
}

command -v npm >/dev/null || sh "$tools/apt.sh" "make test" npm || fail "npm is missing"
echo "make test: installing npm packages (250 MB) into tests/peers/node_modules"
# Programs of packages are not run at installation; none of these needs any.
timeout 300 npm install --ignore-scripts --no-package-lock --no-audit --no-fund --no-update-notifier \
    --prefer-offline --fetch-retries=1 --fetch-retry-mintimeout=1000 --loglevel=error >/dev/null ||
    fail "npm could not install them; its own message is above"
touch "$stamp"
