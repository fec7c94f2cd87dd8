#!/bin/sh
# Installs Debian packages: as root with apt it does, for anybody else it prints the line that would.
# Usage: tools/apt.sh WHY PACKAGE...      Exit status 1 when the packages are still missing.
set -eu
why=$1
shift
if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
    echo "$why: installing $*"
    export DEBIAN_FRONTEND=noninteractive
    apt-get -qq -o DPkg::Lock::Timeout=120 update >/dev/null &&
        apt-get -qq -y -o DPkg::Lock::Timeout=120 install --no-install-recommends "$@" >/dev/null &&
        exit 0
    echo "$why: apt-get could not install $*; its own message is above" >&2
    exit 1
fi
echo "$why: missing on this machine. To install: sudo apt-get install $*" >&2
exit 1
