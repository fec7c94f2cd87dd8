#!/bin/sh
# Runs a command where it may make network namespaces: as root as it is, as an ordinary user in
# namespaces of its own, if the kernel allows that.  Usage: tools/isolated.sh COMMAND [ARGUMENT ...]
set -eu
PATH=$PATH:/usr/sbin:/sbin
# `ip netns` keeps its names in /run; loopback is down in a new namespace.
inside='mount -t tmpfs none /run && ip link set lo up && exec "$@"'
isolate() { unshare --user --map-root-user --mount --net sh -c "$inside" sh "$@"; }

if [ "$(id -u)" -ne 0 ] && isolate true 2>/dev/null; then
    # Otherwise temporary folders would be those of root, by name.
    LOGNAME=$(id -un) isolate "$@"
else
    exec "$@"
fi
