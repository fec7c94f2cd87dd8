"""What the kernel knows of the way to an IPv4 address: route and neighbour table (rtnetlink).

Reading takes no privilege.  The kernel checks a neighbour only while something is sent to it, at
its own pace: with its usual settings it notices after 15 to 53 s that one has gone.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from enum import Enum, IntEnum, auto
from typing import NamedTuple

from eap.errors import EnvironmentalError
from eap.ids import MacAddr
from eap.pd.monitor import Evidence

_NETLINK_ROUTE = 0
_NEWROUTE, _GETROUTE, _NEWNEIGH, _GETNEIGH = 24, 26, 28, 30
_NLM_F_REQUEST = 1
_NDA_DST, _NDA_LLADDR = 1, 2
_RTA_DST, _RTA_SRC, _RTA_OIF, _RTA_GATEWAY = 1, 2, 4, 5
_RTN_UNICAST, _RTN_LOCAL = 1, 2

_HEADER = struct.Struct("@IHHII")  # length, type, flags, sequence, port
_NEIGHBOUR = struct.Struct("@BxxxiHBB")  # family, interface, state, flags, type
_ROUTE = struct.Struct("@8BI")  # family, sizes, TOS, table, protocol, scope, type; flags
_ATTRIBUTE = struct.Struct("@HH")
_ROUTE_TYPE = 7
_ANSWER_SIZE = 8192


class NeighbourState(IntEnum):
    """How the kernel stands with a neighbour (RFC 4861 7.3.2, for IPv4 too)."""

    NONE = 0x00
    INCOMPLETE = 0x01
    REACHABLE = 0x02
    STALE = 0x04
    DELAY = 0x08
    PROBE = 0x10
    FAILED = 0x20
    NOARP = 0x40
    PERMANENT = 0x80

    @property
    def evidence(self) -> Evidence:
        """What it says of who is there; an entry that nobody ever checks says nothing."""
        return _EVIDENCE.get(self, Evidence.PENDING)


_EVIDENCE = {
    NeighbourState.REACHABLE: Evidence.SEEN,
    NeighbourState.FAILED: Evidence.ABSENT,
    NeighbourState.NOARP: Evidence.BLIND,
    NeighbourState.PERMANENT: Evidence.BLIND,
}


class Neighbour(NamedTuple):
    """An entry of the table."""

    state: NeighbourState
    mac: MacAddr | None
    """None while it is not known."""


class RouteKind(Enum):
    """Where datagrams to an address go."""

    LOCAL = auto()
    """To this machine itself."""
    DIRECT = auto()
    """To the neighbour that has the address."""
    GATEWAY = auto()
    """To a neighbour that passes them on."""
    NONE = auto()
    """Nowhere, or to many."""


class Route(NamedTuple):
    """The way to an address; *neighbour* is the next on it."""

    kind: RouteKind
    interface: int = 0
    neighbour: str = ""


class NeighbourTable:
    """One rtnetlink socket; all calls are answered at once, without waiting for anybody.

    Raises:
        EnvironmentalError: the socket cannot be opened.
    """

    def __init__(self) -> None:
        try:
            self._sock = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_ROUTE)
        except OSError as error:
            raise EnvironmentalError(
                f"the neighbour table cannot be read: {error.strerror} "
                "(a sandbox that forbids AF_NETLINK?)"
            ) from None
        self._sock.setblocking(False)
        self._sequence = 0

    def look(self, address: str, source: str = "") -> Evidence:
        """Say whether the kernel lately reached the host that has *address*.

        That can be told of hosts on the same network.  Addresses of this machine itself have no
        neighbour, and behind a gateway nothing can be told but that the gateway is gone.

        Args:
            address: IPv4 address of one host.
            source: Own address from which frames are sent, empty if any.
        """
        route = self.route(address, source)
        if route.kind in {RouteKind.LOCAL, RouteKind.NONE}:
            return Evidence.BLIND
        neighbour = self.neighbour(route.neighbour, route.interface)
        evidence = Evidence.PENDING if neighbour is None else neighbour.state.evidence
        if route.kind is RouteKind.GATEWAY and evidence is not Evidence.ABSENT:
            return Evidence.BLIND
        return evidence

    def route(self, address: str, source: str = "") -> Route:
        """Return the way that a datagram from *source* to *address* takes."""
        attributes = _attribute(_RTA_DST, socket.inet_aton(address))
        if source:
            attributes += _attribute(_RTA_SRC, socket.inet_aton(source))
        head = _ROUTE.pack(socket.AF_INET, 32, 32 if source else 0, 0, 0, 0, 0, 0, 0)
        answer = self._ask(_GETROUTE, _NEWROUTE, head + attributes)
        if answer is None:
            return Route(RouteKind.NONE)
        kind = _ROUTE.unpack_from(answer)[_ROUTE_TYPE]
        found = dict(_attributes(answer, _ROUTE.size))
        if kind == _RTN_LOCAL:
            return Route(RouteKind.LOCAL)
        if kind != _RTN_UNICAST or _RTA_OIF not in found:
            return Route(RouteKind.NONE)
        interface = int(struct.unpack("@i", found[_RTA_OIF])[0])
        if _RTA_GATEWAY in found:
            return Route(RouteKind.GATEWAY, interface, socket.inet_ntoa(found[_RTA_GATEWAY]))
        return Route(RouteKind.DIRECT, interface, address)

    def neighbour(self, address: str, interface: int) -> Neighbour | None:
        """Return the entry of *address* at the interface of that index, None if there is none."""
        head = _NEIGHBOUR.pack(socket.AF_INET, interface, 0, 0, 0)
        wanted = head + _attribute(_NDA_DST, socket.inet_aton(address))
        answer = self._ask(_GETNEIGH, _NEWNEIGH, wanted)
        if answer is None:
            return None
        state = _NEIGHBOUR.unpack_from(answer)[2]
        found = dict(_attributes(answer, _NEIGHBOUR.size))
        mac = found.get(_NDA_LLADDR, b"")
        return Neighbour(
            NeighbourState(state) if state in _STATES else NeighbourState.NONE,
            MacAddr(mac) if len(mac) == 6 else None,
        )

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._sock.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()

    def _ask(self, question: int, answer: int, body: bytes) -> bytes | None:
        """Return the body of the kernel's answer, None if it refuses or has none."""
        self._sequence = self._sequence + 1 & 0xFFFFFFFF
        size = _HEADER.size + len(body)
        head = _HEADER.pack(size, question, _NLM_F_REQUEST, self._sequence, 0)
        try:
            self._sock.sendto(head + body, (0, 0))
            while True:
                data, sender = self._sock.recvfrom(_ANSWER_SIZE)
                length, kind, _, sequence, _ = _HEADER.unpack_from(data)
                if sender[0] == 0 and sequence == self._sequence:  # not of an earlier question
                    return data[_HEADER.size : length] if kind == answer else None
        except OSError:
            return None


_STATES = frozenset(NeighbourState)


def _attribute(kind: int, value: bytes) -> bytes:
    return _ATTRIBUTE.pack(_ATTRIBUTE.size + len(value), kind) + value


def _attributes(data: bytes, offset: int) -> Iterator[tuple[int, bytes]]:
    while offset + _ATTRIBUTE.size <= len(data):
        size, kind = _ATTRIBUTE.unpack_from(data, offset)
        if size < _ATTRIBUTE.size:
            return
        yield kind, data[offset + _ATTRIBUTE.size : offset + size]
        offset += size + 3 & ~3
