"""What this machine's network interfaces are and do, asked of the kernel."""

from __future__ import annotations

import ctypes
import fcntl
import socket
import struct

from eap.errors import EnvironmentalError

_SIOCGIFCONF = 0x8912
_SIOCGIFFLAGS = 0x8913
_IFF_UP = 0x1
_IFF_RUNNING = 0x40
_IFREQ_SIZE = 40
_INTERFACES = 1024
_NAME_LIMIT = 15


def interface_of(address: str) -> str:
    """Return the name of the interface that has IPv4 *address*.

    Raises:
        EnvironmentalError: none has it.
    """
    if address.startswith("127."):
        return "lo"
    memory = ctypes.create_string_buffer(_INTERFACES * _IFREQ_SIZE)
    request = struct.pack("@iP", len(memory), ctypes.addressof(memory))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        size = struct.unpack("@iP", fcntl.ioctl(sock.fileno(), _SIOCGIFCONF, request))[0]
    wanted = socket.inet_aton(address)
    data = memory.raw
    for offset in range(0, size, _IFREQ_SIZE):
        if data[offset + 20 : offset + 24] == wanted:
            label = data[offset : offset + 16].split(b"\0", 1)[0].decode()
            return label.partition(":")[0]
    raise EnvironmentalError(foreign_address(address))


def foreign_address(address: str) -> str:
    """Say in one line that *address* is not this machine's."""
    return (
        f"{address} is not an address of this machine: `ip -4 addr` lists those that are; "
        "any of 127.0.0.0/8 works within this machine"
    )


def check_interface(name: str) -> None:
    """Check that *name* exists and is switched on; a cable is not needed.

    Raises:
        EnvironmentalError: it does not, or is not; the message names those that are there.
    """
    flags = _flags(name)
    if flags is None:
        known = ", ".join(sorted(found for _, found in socket.if_nameindex()))
        raise EnvironmentalError(f"there is no interface {name!r}, expected one of {known}")
    if not flags & _IFF_UP:
        raise EnvironmentalError(
            f"interface {name} is down: `ip link set {name} up` as root switches it on"
        )


def link_is_up(name: str) -> bool:
    """Whether interface *name* exists, is switched on and has a live cable."""
    flags = _flags(name)
    return flags is not None and flags & (_IFF_UP | _IFF_RUNNING) == _IFF_UP | _IFF_RUNNING


def _flags(name: str) -> int | None:
    if len(name.encode()) > _NAME_LIMIT:
        return None
    request = struct.pack("@16s24x", name.encode())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            answer = fcntl.ioctl(sock.fileno(), _SIOCGIFFLAGS, request)
        except OSError:
            return None
    return int(struct.unpack_from("@H", answer, 16)[0])
