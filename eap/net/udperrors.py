"""What ICMP says about datagrams sent: the error queue of a UDP socket.  It needs no privilege.

The queue is beside the one that datagrams arrive in, so another process than the one that sends may
read it.  Two things follow from asking for errors.  Each also makes the next call on the socket
fail, be it about another destination: that call has to be made once more.  And of sockets that
share an address (SO_REUSEPORT) each gets the errors of some destinations, so all must be asked.
"""

from __future__ import annotations

import errno
import socket
import struct
from typing import NamedTuple

IP_RECVERR = 11
ERRORS_PER_CALL = 256
ICMP_ERRNOS = frozenset(
    {
        errno.ECONNREFUSED,
        errno.EHOSTUNREACH,
        errno.ENETUNREACH,
        errno.EHOSTDOWN,
        errno.ENOPROTOOPT,
        errno.EPROTO,
        errno.EMSGSIZE,
        errno.EACCES,
    }
)
"""What a call fails with because of an earlier datagram (and some of them for its own sake)."""

_EXTENDED_ERROR = struct.Struct("@IBBBxII")  # errno, origin, type, code, info, data
_CONTROL_SIZE = 512
_ORIGIN_ICMP = 2
_UNREACHABLE = 3
_TIME_EXCEEDED = 11
_TOO_LARGE = 4


class UdpError(NamedTuple):
    """One datagram about which somebody complained."""

    address: str
    """Where it was sent, as is *port*."""
    port: int
    unreachable: bool
    """Whether it did not arrive, because nobody listens there or because of the way there."""
    reason: str
    """The errno's name, such as ECONNREFUSED."""


def enable_errors(sock: socket.socket) -> None:
    """Have the kernel queue what it learns about datagrams that *sock* sends from now on."""
    sock.setsockopt(socket.IPPROTO_IP, IP_RECVERR, 1)


def take_errors(sock: socket.socket, limit: int = ERRORS_PER_CALL) -> list[UdpError]:
    """Take at most *limit* errors from the queue of *sock*, without waiting."""
    found: list[UdpError] = []
    for _ in range(limit):
        try:
            _, control, _, address = sock.recvmsg(
                1, _CONTROL_SIZE, socket.MSG_ERRQUEUE | socket.MSG_DONTWAIT
            )
        except OSError:  # empty: what is pending without an entry says nothing of a destination
            break
        for level, kind, data in control:
            if (level, kind) == (socket.IPPROTO_IP, IP_RECVERR):
                found.append(_parse(data, address))
    return found


def _parse(data: bytes, address: tuple[str, int]) -> UdpError:
    number, origin, kind, code, _, _ = _EXTENDED_ERROR.unpack_from(data)
    return UdpError(
        *address,
        origin == _ORIGIN_ICMP
        and (kind == _TIME_EXCEEDED or (kind == _UNREACHABLE and code != _TOO_LARGE)),
        errno.errorcode.get(number, str(number)),
    )
