"""How services can tell whether anybody is where a frame goes: what they ask and what they hear."""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterable
from contextlib import ExitStack
from typing import NamedTuple

from eap.codec.ethercat import EAP_PORT
from eap.errors import EnvironmentalError
from eap.ids import Destination
from eap.net.arpprobe import ArpProber
from eap.net.neighbour import NeighbourTable
from eap.net.udperrors import ERRORS_PER_CALL, enable_errors, take_errors
from eap.pd.monitor import Evidence
from eap.runtime.handover import Handover, PortName, SharedSocket, SocketKind

logger = logging.getLogger(__name__)

REFUSAL_NS = 3_000_000_000
"""How long a refusal holds while frames go on: hosts tell about one a second, whatever is sent."""
_CALLS_PER_TURN = 8


class UdpWay:
    """What ICMP says of the frames of one UDP port, and what the kernel knows of their targets.

    *sockets* are those of the port, the engine's included: which of them gets an error is up to the
    kernel.  Nothing is sent.
    """

    def __init__(
        self, sockets: Iterable[socket.socket], table: NeighbourTable | None, own_address: str
    ) -> None:
        self.sockets = tuple(sockets)
        self._table = table
        self._source = "" if own_address == "0.0.0.0" else own_address  # noqa: S104  a comparison
        self._refused_at_ns: dict[tuple[str, int], int] = {}
        self._refused: set[tuple[str, int]] = set()
        self._is_enabled = False

    def watch(self, targets: Iterable[Destination]) -> None:
        """Take note of errors about *targets* from now on, and about no others."""
        wanted = {key_of(target) for target in targets}
        known = self._refused_at_ns
        self._refused_at_ns = {target: known.get(target, 0) for target in wanted}
        if wanted and not self._is_enabled:
            for sock in self.sockets:
                enable_errors(sock)
            self._is_enabled = True

    def collect(self, now_ns: int) -> None:
        """Take what ICMP told, for :meth:`hear`.

        While errors wait, whoever waits for frames at these sockets is woken again and again.
        """
        for sock in self.sockets if self._is_enabled else ():
            for _ in range(_CALLS_PER_TURN):
                errors = take_errors(sock)
                for each in errors:
                    target = each.address, each.port
                    if each.unreachable and target in self._refused_at_ns:
                        self._refused_at_ns[target] = now_ns
                        self._refused.add(target)
                if len(errors) < ERRORS_PER_CALL:
                    break

    def hear(self, now_ns: int) -> set[tuple[str, int]]:
        """Return address and port of the targets that were not reached since the last call."""
        self.collect(now_ns)
        found, self._refused = self._refused, set()
        return found & self._refused_at_ns.keys()

    def look(self, target: Destination, sent_at_ns: int) -> Evidence:
        """Return what is known of *target*, to which a frame was sent last at *sent_at_ns*.

        A refusal holds until frames have been sent for a while without another one.
        """
        key = key_of(target)
        refused_at_ns = self._refused_at_ns.get(key, 0)
        if refused_at_ns:
            if sent_at_ns - refused_at_ns < REFUSAL_NS:
                return Evidence.ABSENT
            self._refused_at_ns[key] = 0
        if self._table is None:
            return Evidence.BLIND
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
    """Return the ways of all EAP ports; *resources* closes what they need."""
    endpoints = Ways({}, {})
    table = _open_table(resources)
    for shared in handover.sockets:
        if shared.kind is SocketKind.UDP:
            endpoint = UdpWay(_both(shared), table, shared.address)
            resources.callback(endpoint.close)
            endpoints.udp.update(dict.fromkeys(shared.owners, endpoint))
        elif shared.kind is SocketKind.ARP:
            spec = handover.port(shared.owners[0])
            sock = socket.socket(fileno=shared.services_fd)
            hop_prober = ArpProber(sock, vlan_id=shared.vlan_id, priority=spec.vlan_priority)
            resources.callback(hop_prober.close)
            endpoints.arp.update(dict.fromkeys(shared.owners, hop_prober))
    return endpoints


def _open_table(resources: ExitStack) -> NeighbourTable | None:
    try:
        table = NeighbourTable()
    except EnvironmentalError as exc:
        logger.warning("%s; subscribers on UDP are known to be missing by ICMP alone", exc)
        return None
    resources.callback(table.close)
    return table


def _both(shared: SharedSocket) -> list[socket.socket]:
    descriptors = shared.engine_fd, shared.services_fd
    return [socket.fromfd(fd, socket.AF_INET, socket.SOCK_DGRAM) for fd in descriptors]


def key_of(target: Destination) -> tuple[str, int]:
    """Return address and port of *target*, as ICMP errors give them."""
    return target.host, target.port or EAP_PORT
