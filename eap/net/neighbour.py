"""Presence of hosts on a network: the kernel's neighbour table (rtnetlink) and probes by ARP.

Reading the table takes no privilege.  The kernel checks a neighbour only while something is sent to
it, at its own pace: with its usual settings it notices after 15 to 53 s that one has gone.

:class:`ArpProber` probes an IPv4 address on one Ethernet interface as RFC 5227 does.  The interface
needs no IPv4 address of its own, and the neighbour table is not involved.
"""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Iterable, Iterator
from enum import Enum, IntEnum, auto
from ipaddress import IPv4Address
from typing import NamedTuple

from eap.codec import arp
from eap.errors import CodecError, EnvironmentalError
from eap.ids import BROADCAST_MAC, MacAddr
from eap.net import bpf
from eap.net.ethernet import ETHERNET_HEADER, MINIMUM_SIZE
from eap.net.interface import interface_of
from eap.net.mmsg import count_error
from eap.net.packetsocket import (
    ARPHRD_LOOPBACK,
    PACKET_AUXDATA,
    SOL_PACKET,
    InterfaceBinding,
)
from eap.pd.monitor import ProbeResult

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
    """State of an entry of the neighbour table (RFC 4861 7.3.2, for IPv4 too)."""

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
    def evidence(self) -> ProbeResult:
        """Presence that the state shows; an entry that the kernel never checks shows none."""
        return _EVIDENCE.get(self, ProbeResult.PENDING)


_EVIDENCE = {
    NeighbourState.REACHABLE: ProbeResult.SEEN,
    NeighbourState.FAILED: ProbeResult.ABSENT,
    # Never checked by the kernel: such an entry stays as it is when its host is gone.
    NeighbourState.NOARP: ProbeResult.BLIND,
    NeighbourState.PERMANENT: ProbeResult.BLIND,
}


class NeighbourEntry(NamedTuple):
    """An entry of the table."""

    state: NeighbourState
    mac: MacAddr | None
    """None while it is not known."""


class RouteKind(Enum):
    """Kind of route of datagrams to an address."""

    LOCAL = auto()
    """To this machine itself."""
    DIRECT = auto()
    """To the neighbour that has the address."""
    GATEWAY = auto()
    """To a neighbour that passes them on."""
    NONE = auto()
    """Nowhere, or to many."""


class KernelRoute(NamedTuple):
    """Route to an address; *neighbour* is the next hop."""

    kind: RouteKind
    interface: int = 0
    neighbour: str = ""


class NeighbourTable:
    """One rtnetlink socket; the kernel answers all queries at once.

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

    def look(self, address: str, source: str = "") -> ProbeResult:
        """Return whether the kernel lately reached the host that has *address*.

        That is known of hosts on the same network.  Addresses of this machine itself have no
        neighbour, and of a host behind a gateway it is only known when the gateway is gone.

        Args:
            address: IPv4 address of one host.
            source: Own address from which frames are sent, empty if any.
        """
        route = self.route(address, source)
        if route.kind in {RouteKind.LOCAL, RouteKind.NONE}:
            return ProbeResult.BLIND
        neighbour = self.neighbour(route.neighbour, route.interface)
        evidence = ProbeResult.PENDING if neighbour is None else neighbour.state.evidence
        # A gateway that is there proves nothing of a host behind it.
        if route.kind is RouteKind.GATEWAY and evidence is not ProbeResult.ABSENT:
            return ProbeResult.BLIND
        return evidence

    def route(self, address: str, source: str = "") -> KernelRoute:
        """Return the route that a datagram from *source* to *address* takes."""
        attributes = _attribute(_RTA_DST, socket.inet_aton(address))
        if source:
            attributes += _attribute(_RTA_SRC, socket.inet_aton(source))
        head = _ROUTE.pack(socket.AF_INET, 32, 32 if source else 0, 0, 0, 0, 0, 0, 0)
        answer = self._ask(_GETROUTE, _NEWROUTE, head + attributes)
        if answer is None:
            return KernelRoute(RouteKind.NONE)
        kind = _ROUTE.unpack_from(answer)[_ROUTE_TYPE]
        found = dict(_attributes(answer, _ROUTE.size))
        if kind == _RTN_LOCAL:
            return KernelRoute(RouteKind.LOCAL)
        if kind != _RTN_UNICAST or _RTA_OIF not in found:
            return KernelRoute(RouteKind.NONE)
        interface = int(struct.unpack("@i", found[_RTA_OIF])[0])
        if _RTA_GATEWAY in found:
            return KernelRoute(RouteKind.GATEWAY, interface, socket.inet_ntoa(found[_RTA_GATEWAY]))
        return KernelRoute(RouteKind.DIRECT, interface, address)

    def neighbour(self, address: str, interface: int) -> NeighbourEntry | None:
        """Return the entry of *address* at the interface of that index, None if there is none."""
        head = _NEIGHBOUR.pack(socket.AF_INET, interface, 0, 0, 0)
        wanted = head + _attribute(_NDA_DST, socket.inet_aton(address))
        answer = self._ask(_GETNEIGH, _NEWNEIGH, wanted)
        if answer is None:
            return None
        state = _NEIGHBOUR.unpack_from(answer)[2]
        found = dict(_attributes(answer, _NEIGHBOUR.size))
        mac = found.get(_NDA_LLADDR, b"")
        return NeighbourEntry(
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
        """Return the body of the kernel's reply, None for an error or an empty reply."""
        self._sequence = self._sequence + 1 & 0xFFFFFFFF
        size = _HEADER.size + len(body)
        head = _HEADER.pack(size, question, _NLM_F_REQUEST, self._sequence, 0)
        try:
            self._sock.sendto(head + body, (0, 0))
            while True:
                data, sender = self._sock.recvfrom(_ANSWER_SIZE)
                length, kind, _, sequence, _ = _HEADER.unpack_from(data)
                # Port 0 is the kernel: any process of this host may send to a netlink socket.
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
        # Attributes are aligned to 4 bytes (rtnetlink), and their length is that without padding.
        offset += size + 3 & ~3


_TPID = 0x8100
_VID = 0x0FFF
_AUXDATA = struct.Struct("@IIIHHHH")  # status, sizes, offsets, TCI, TPID
_CONTROL_SIZE = 128  # room for the time stamp of every packet socket, too
_FRAMES_PER_DRAIN = 256


class ArpSighting(NamedTuple):
    """An ARP message about a watched address."""

    address: IPv4Address
    mac: MacAddr
    """Its sender."""
    is_claim: bool
    """False: it has the address.  True: it checks whether it may take it (RFC 5227 2.1.1)."""


class ArpProber:
    """Sends and receives ARP in one VLAN of an interface; 0 is untagged.  It never waits.

    An interface that is deleted and made again is found again by its name.

    Attributes:
        errors: Failed system calls by errno name, and messages that made no sense.
    """

    def __init__(
        self, sock: socket.socket, *, vlan_id: int = 0, priority: int = 0, interface: str = ""
    ) -> None:
        sock.setblocking(False)
        self.errors: dict[str, int] = {}
        self._kind = sock.getsockname()[3]
        self._binding = InterfaceBinding(sock, interface)
        self.interface = self._binding.name
        self._sock = sock
        self._vlan_id = vlan_id
        tag = priority << 13 | vlan_id
        self._tail = struct.pack("!HH", _TPID, tag) if tag else b""
        self._tail += struct.pack("!H", arp.ETHERTYPE_ARP)
        self._watched: frozenset[IPv4Address] = frozenset()

    @property
    def mac(self) -> MacAddr:
        """Own address."""
        return self._binding.address

    def watch(self, addresses: Iterable[IPv4Address]) -> None:
        """Receive ARP messages about *addresses* from now on, and about no others.

        Raises:
            EnvironmentalError: they are more than a filter or the kernel has room for.
        """
        wanted = frozenset(addresses)
        try:
            bpf.attach(self._sock, bpf.arp_filter(wanted))
        except OSError as error:
            raise EnvironmentalError(
                f"interface {self.interface}: {len(wanted)} addresses cannot be monitored: "
                f"{error.strerror} (`sysctl net.core.optmem_max` is what one socket may take)"
            ) from None
        self._watched = wanted

    def probe(self, address: IPv4Address) -> bool:
        """Send an ARP probe for *address*; return whether a reply can be expected.

        It cannot for addresses of this machine, which does not receive its own probes, on the
        loopback interface, where ARP is not answered, and where the kernel did not send.
        """
        if self._kind == ARPHRD_LOOPBACK or _is_own(address):
            return False
        head = BROADCAST_MAC + self.mac + self._tail
        message = arp.ArpMessage.probe(self.mac, address).encode()
        try:
            self._sock.send((head + message).ljust(MINIMUM_SIZE, b"\0"))
        except OSError as error:
            count_error(self.errors, error.errno)
            return False
        return True

    def drain(self) -> list[ArpSighting]:
        """Return the ARP messages about the watched addresses, from at most 256 frames."""
        found: list[ArpSighting] = []
        for _ in range(_FRAMES_PER_DRAIN):
            try:
                data, control, _, _ = self._sock.recvmsg(ETHERNET_HEADER + arp.SIZE, _CONTROL_SIZE)
            except BlockingIOError:
                break
            except OSError as error:
                count_error(self.errors, error.errno)
                if error.errno == errno.ENETDOWN:
                    self._binding.is_lost = True
                break
            if _vlan_of(control) == self._vlan_id and (heard := self._parse(data)):
                found.append(heard)
        self._binding.find()
        return found

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a message waits."""
        return self._sock.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()

    def _parse(self, data: bytes) -> ArpSighting | None:
        try:
            message = arp.ArpMessage.decode(data, ETHERNET_HEADER)
        except CodecError:
            self.errors["malformed"] = self.errors.get("malformed", 0) + 1
            return None
        if message.sender_mac == self.mac:
            return None
        address = message.target if message.is_probe else message.sender
        if address not in self._watched or not (message.is_probe or message.shows_sender):
            return None
        return ArpSighting(address, message.sender_mac, message.is_probe)


def _is_own(address: IPv4Address) -> bool:
    try:
        interface_of(str(address))
    except EnvironmentalError:
        return False
    return True


def _vlan_of(control: list[tuple[int, int, bytes]]) -> int:
    for level, kind, data in control:
        if (level, kind) == (SOL_PACKET, PACKET_AUXDATA):
            return int(_AUXDATA.unpack_from(data)[5]) & _VID
    return 0
