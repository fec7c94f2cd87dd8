"""By which ways services can tell whether anybody is where a frame goes: what they ask, and hear."""

from __future__ import annotations

import socket
from collections.abc import Iterable
from contextlib import ExitStack
from typing import NamedTuple

from eap.appliance.handover import Handover, PortName, SharedSocket, SocketKind
from eap.codec.ethercat import EAP_PORT
from eap.ids import Destination
from eap.net.arpprobe import ArpProber
from eap.net.neighbour import NeighbourTable
from eap.net.udperrors import enable_errors, take_errors
from eap.pd.presence import Evidence

REFUSAL_NS = 3_000_000_000
"""How long a refusal holds while frames go on: hosts tell about one a second, whatever is sent."""
_CALLS_PER_TURN = 8


class UdpWay:
    """What ICMP says of the frames of one UDP port, and what the kernel knows of their targets.

    *sockets* are those of the port, the engine's included: which of them gets an error is up to the
    kernel.  Nothing is sent.
    """

    def __init__(
        self, sockets: Iterable[socket.socket], table: NeighbourTable, own_address: str
    ) -> None:
        self.sockets = tuple(sockets)
        self._table = table
        self._source = "" if own_address == "0.0.0.0" else own_address  # noqa: S104  a comparison
        self._refused_at_ns: dict[tuple[str, int], int] = {}
        self._is_enabled = False

    def watch(self, targets: Iterable[Destination]) -> None:
        """Take note of errors about *targets* from now on, and about no others."""
        wanted = {_key(target) for target in targets}
        known = self._refused_at_ns
        self._refused_at_ns = {target: known.get(target, 0) for target in wanted}
        if wanted and not self._is_enabled:
            for sock in self.sockets:
                enable_errors(sock)
            self._is_enabled = True

    def hear(self, now_ns: int) -> set[tuple[str, int]]:
        """Take what ICMP told; return address and port of the targets that were not reached."""
        found = set()
        for sock in self.sockets if self._is_enabled else ():
            for _ in range(_CALLS_PER_TURN):
                errors = take_errors(sock)
                found.update((each.address, each.port) for each in errors if each.unreachable)
                if not errors:
                    break
        found.intersection_update(self._refused_at_ns)
        for target in found:
            self._refused_at_ns[target] = now_ns
        return found

    def look(self, target: Destination, sent_at_ns: int) -> Evidence:
        """Return what is known of *target*, to which a frame was sent last at *sent_at_ns*.

        A refusal holds until frames have been sent for a while without another one.
        """
        key = _key(target)
        refused_at_ns = self._refused_at_ns.get(key, 0)
        if refused_at_ns:
            if sent_at_ns - refused_at_ns < REFUSAL_NS:
                return Evidence.ABSENT
            self._refused_at_ns[key] = 0
        return self._table.look(target.host, self._source)

    def close(self) -> None:
        """Close the sockets."""
        for sock in self.sockets:
            sock.close()


class Ways(NamedTuple):
    """All ways of an appliance, by port."""

    arp: dict[PortName, ArpProber]
    udp: dict[PortName, UdpWay]


def open_ways(handover: Handover, resources: ExitStack) -> Ways:
    """Return the ways of all EAP ports; *resources* closes what they need.

    Raises:
        EnvironmentalError: the neighbour table cannot be read.
    """
    ways = Ways({}, {})
    datagrams = [each for each in handover.sockets if each.kind is SocketKind.UDP]
    table = NeighbourTable() if datagrams else None
    if table is not None:
        resources.callback(table.close)
        for shared in datagrams:
            way = UdpWay(_both(shared), table, shared.address)
            resources.callback(way.close)
            ways.udp.update(dict.fromkeys(shared.owners, way))
    for shared in handover.sockets:
        if shared.kind is SocketKind.ARP:
            spec = handover.port(shared.owners[0])
            sock = socket.socket(fileno=shared.services_fd)
            prober = ArpProber(sock, vlan_id=shared.vlan_id, priority=spec.vlan_priority)
            resources.callback(prober.close)
            ways.arp.update(dict.fromkeys(shared.owners, prober))
    return ways


def _both(shared: SharedSocket) -> list[socket.socket]:
    descriptors = shared.engine_fd, shared.services_fd
    return [socket.fromfd(fd, socket.AF_INET, socket.SOCK_DGRAM) for fd in descriptors]


def _key(target: Destination) -> tuple[str, int]:
    return target.host, target.port or EAP_PORT
