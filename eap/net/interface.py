"""Network interfaces of this machine: addresses, flags and link state, from the kernel."""

from __future__ import annotations

import ctypes
import fcntl
import socket
import struct
from functools import cache

from eap.errors import EnvironmentalError
from eap.ids import INTERFACE_NAME_SIZE

_SIOCGIFCONF = 0x8912
_SIOCGIFFLAGS = 0x8913
_SIOCGIFBRDADDR = 0x8919
_IFF_UP = 0x1
_IFF_RUNNING = 0x40
_IFREQ_SIZE = 40
_INTERFACES = 1024


@cache
def _kernel() -> socket.socket:
    """Return the socket for all queries; kept, so that no query needs a free descriptor."""
    return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)


def interface_of(address: str) -> str:
    """Return the name of the interface that has IPv4 *address*.

    Raises:
        EnvironmentalError: none has it.
    """
    return "lo" if address.startswith("127.") else _label_of(address).partition(":")[0]


def _label_of(address: str) -> str:
    """Return the label under which the kernel lists *address*: ``eth0``, or perhaps ``eth0:1``."""
    for label, own in own_addresses():
        if own == address:
            return label
    raise EnvironmentalError(foreign_address(address))


def broadcast_of(address: str) -> str:
    """Return the broadcast address of the network that *address* of this machine is in.

    Empty if it has none, as on a line with two ends.
    """
    if address.startswith("127."):
        return "127.255.255.255"  # which the kernel knows, but does not tell
    # Name and address together find one of several addresses of an interface.
    name = _label_of(address).encode()
    request = struct.pack("@16sHH4s16x", name, socket.AF_INET, 0, socket.inet_aton(address))
    try:
        answer = fcntl.ioctl(_kernel().fileno(), _SIOCGIFBRDADDR, request)
    except OSError:
        return ""
    found = socket.inet_ntoa(answer[20:24])
    return "" if found in {"0.0.0.0", address} else found  # noqa: S104  a comparison


def own_addresses() -> list[tuple[str, str]]:
    """Return all IPv4 addresses of this machine now, each behind its label (``eth0:1``)."""
    memory = ctypes.create_string_buffer(_INTERFACES * _IFREQ_SIZE)
    request = struct.pack("@iP", len(memory), ctypes.addressof(memory))
    size = struct.unpack("@iP", fcntl.ioctl(_kernel().fileno(), _SIOCGIFCONF, request))[0]
    data = memory.raw
    found = []
    for offset in range(0, size, _IFREQ_SIZE):
        label = data[offset : offset + 16].split(b"\0", 1)[0].decode()
        found.append((label, socket.inet_ntoa(data[offset + 20 : offset + 24])))
    return found


def foreign_address(address: str) -> str:
    """Return in one line that *address* is not this machine's."""
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


def is_switched_on(name: str) -> bool:
    """Return whether interface *name* exists and is switched on, with or without a cable."""
    flags = _flags(name)
    return flags is not None and bool(flags & _IFF_UP)


def is_there(name: str) -> bool:
    """Return whether interface *name* exists."""
    return _flags(name) is not None


def link_is_up(name: str) -> bool:
    """Return whether interface *name* exists, is switched on and has a live cable.

    Raises:
        OSError: no descriptor is left for the first query of this process.
    """
    flags = _flags(name)
    return flags is not None and flags & (_IFF_UP | _IFF_RUNNING) == _IFF_UP | _IFF_RUNNING


def _flags(name: str) -> int | None:
    if len(name.encode()) > INTERFACE_NAME_SIZE:
        return None
    request = struct.pack("@16s24x", name.encode())
    sock = _kernel()
    try:
        answer = fcntl.ioctl(sock.fileno(), _SIOCGIFFLAGS, request)
    except OSError:
        return None
    return int(struct.unpack_from("@H", answer, 16)[0])
