"""TAP interface: Ethernet frames between this program and the network stack of the host."""

from __future__ import annotations

import errno
import fcntl
import os
import pwd
import socket
import struct
from collections.abc import Iterator
from ipaddress import IPv4Interface

from eap.errors import EnvironmentalError

_DEVICE = "/dev/net/tun"
_TUNSETIFF = 0x400454CA
_IFF_TAP, _IFF_NO_PI = 0x0002, 0x1000
_SIOCGIFFLAGS, _SIOCSIFFLAGS = 0x8913, 0x8914
_SIOCSIFADDR, _SIOCSIFNETMASK = 0x8916, 0x891C
_IFF_UP = 0x1
_LARGEST = 2048
_AT_ONCE = 32
"""Frames of one read, so that others of this process have a turn."""
_FLAGS = struct.Struct("@16sH22x")
_ADDRESS = struct.Struct("@16sHH4s16x")


class TapPort:
    """An open TAP interface; without *address* its addresses are the administrator's.

    Args:
        name: Of the interface; it is made if it does not exist, and removed at the end.
        address: To be given to the interface, with the length of its network.

    Attributes:
        name: As given.
        dropped: Frames that the kernel did not take.

    Raises:
        EnvironmentalError: it cannot be opened, switched on, or given the address.
    """

    def __init__(self, name: str, address: IPv4Interface | None = None) -> None:
        self.name = name
        self.dropped = 0
        try:
            self._fd = os.open(_DEVICE, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as exc:
            raise EnvironmentalError(
                f"TAP interface {name}: {_DEVICE} cannot be opened: {exc.strerror};"
                " load the kernel module tun, and allow this user to open the device"
            ) from None
        try:
            self._attach()
            self._set_up(address)
        except BaseException:
            os.close(self._fd)
            raise

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the host sends a frame."""
        return self._fd

    def close(self) -> None:
        """Close it; an interface that was made here disappears."""
        os.close(self._fd)

    def read_frames(self) -> Iterator[bytes]:
        """Yield some of the frames that the host has sent; raise OSError if it is gone."""
        for _ in range(_AT_ONCE):
            try:
                yield os.read(self._fd, _LARGEST)
            except BlockingIOError:
                return

    def write_frame(self, frame: bytes) -> None:
        """Give the host a frame; one that it does not take is counted."""
        try:
            os.write(self._fd, frame)
        except OSError:
            self.dropped += 1

    def is_up(self) -> bool:
        """Return whether the interface exists and is switched on."""
        try:
            return bool(self._flags() & _IFF_UP)
        except OSError:
            return False

    def _attach(self) -> None:
        request = _FLAGS.pack(self.name.encode(), _IFF_TAP | _IFF_NO_PI)
        try:
            fcntl.ioctl(self._fd, _TUNSETIFF, request)
        except OSError as exc:
            raise EnvironmentalError(
                f"TAP interface {self.name}: {_reason(exc, self.name)}"
            ) from None

    def _set_up(self, address: IPv4Interface | None) -> None:
        name = self.name.encode()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            try:
                if address is not None:
                    for command, each in (
                        (_SIOCSIFADDR, address.ip),
                        (_SIOCSIFNETMASK, address.netmask),
                    ):
                        fcntl.ioctl(
                            sock, command, _ADDRESS.pack(name, socket.AF_INET, 0, each.packed)
                        )
                if not (flags := self._flags()) & _IFF_UP:
                    fcntl.ioctl(sock, _SIOCSIFFLAGS, _FLAGS.pack(name, flags | _IFF_UP))
            except PermissionError:
                # An interface that the administrator has prepared needs nothing of this.
                if not self.is_up():
                    raise EnvironmentalError(
                        f"TAP interface {self.name} is down: `ip link set {self.name} up` as root"
                        " switches it on"
                    ) from None
            except OSError as exc:
                raise EnvironmentalError(
                    f"TAP interface {self.name}: address {address}: {exc.strerror}"
                ) from None

    def _flags(self) -> int:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            answer = fcntl.ioctl(sock, _SIOCGIFFLAGS, _FLAGS.pack(self.name.encode(), 0))
        return int(_FLAGS.unpack(answer)[1])


def _reason(error: OSError, name: str) -> str:
    match error.errno:
        case errno.EPERM:
            return (
                "not permitted: give this program CAP_NET_ADMIN, or prepare the interface as root:"
                f" `ip tuntap add dev {name} mode tap user {_user()}`, `ip link set {name} up`"
            )
        case errno.EBUSY:
            return "it is open already, by another program or another bus; name another interface"
        case errno.EINVAL:
            return "an interface with this name exists and is no TAP interface; name another one"
    return os.strerror(error.errno or 0)


def _user() -> str:
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return str(os.getuid())
