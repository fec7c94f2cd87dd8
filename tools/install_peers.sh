#!/bin/sh
# Makes sure of the Debian programs that a group of commands meets as peers or builds its networks with;
# for tests also of npm packages.
# Usage: tools/install_peers.sh test|package|bench      Exit status 1 when a program is still missing.
set -eu
here=$(dirname "$0")
case ${1:-} in
    # command=package
    test) wanted="tshark=tshark ip=iproute2 setpriv=util-linux mosquitto=mosquitto mosquitto_sub=mosquitto-clients openssl=openssl prometheus=prometheus pg_ctlcluster=postgresql chromium-headless-shell=chromium-headless-shell tmux=tmux" ;;
    package) wanted="debootstrap=debootstrap buildah=buildah ssh=openssh-client unshare=util-linux pipx=pipx" ;;
    bench) wanted="cyclictest=rt-tests ip=iproute2 taskset=util-linux" ;;
    *)
        echo "usage: $0 test|package|bench" >&2
        exit 2
        ;;
esac

packages=""
for pair in $wanted; do
    PATH=$PATH:/usr/sbin:/sbin command -v "${pair%%=*}" >/dev/null || packages="$packages ${pair#*=}"
done
# Without npm packages, for which some machines have no registry, only few tests are skipped.
[ "$1" != test ] || sh "$here/npm_peers.sh" || :
[ -n "$packages" ] || exit 0
# shellcheck disable=SC2086  # a list of package names
exec sh "$here/apt.sh" "make $1" $packages
