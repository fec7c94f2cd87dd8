"""Subscriber monitoring in services: the monitored targets, their answers and their texts.

It follows the images: it reads the monitored frames and their present targets there again and
again, so a station may be reconfigured and a frame may get another target.
"""

from __future__ import annotations

import asyncio
import logging
import os
import select
import socket
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from ipaddress import IPv4Address
from time import monotonic_ns
from typing import NamedTuple, Protocol

from eap.codec.ethercat import EAP_PORT
from eap.errors import EnvironmentalError, ImageError
from eap.ids import Destination, DestinationKind, MacAddr
from eap.net.neighbour import ArpProber, NeighbourTable
from eap.net.udp import ERRORS_PER_CALL, enable_errors, read_errors
from eap.pd.address import from_word
from eap.pd.image import Image
from eap.pd.layout import FrameSlot
from eap.pd.monitor import (
    MonitorTarget,
    PresenceChanged,
    ProbeResult,
    SubscriberMonitor,
    SubscriberPresence,
)
from eap.pd.spec import PortSpec
from eap.pd.words import FrameWord
from eap.runtime.handover import PortName, SharedSocket, SocketKind

logger = logging.getLogger(__name__)

# Hosts tell about one a second, whatever is sent.
REFUSAL_NS = 3_000_000_000
"""Time that a refusal stays valid while frames go on."""
_CALLS_PER_TURN = 8


class UdpSubscriberProbe:
    """ICMP errors for the frames of one UDP port, and the kernel's knowledge of their targets.

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
        """Read the ICMP errors, for :meth:`refused_targets`."""
        # Pending errors wake the reader of frames at these sockets again and again.
        for sock in self.sockets if self._is_enabled else ():
            for _ in range(_CALLS_PER_TURN):
                errors = read_errors(sock)
                for each in errors:
                    target = each.address, each.port
                    if each.unreachable and target in self._refused_at_ns:
                        self._refused_at_ns[target] = now_ns
                        self._refused.add(target)
                # Fewer than a call can take: the queue is empty.
                if len(errors) < ERRORS_PER_CALL:
                    break

    def refused_targets(self, now_ns: int) -> set[tuple[str, int]]:
        """Return address and port of the targets that were not reached since the last call."""
        self.collect(now_ns)
        found, self._refused = self._refused, set()
        return found & self._refused_at_ns.keys()

    def evidence_of(self, target: Destination, sent_at_ns: int) -> ProbeResult:
        """Return the evidence about *target*, to which a frame was sent last at *sent_at_ns*.

        A refusal holds until frames have been sent for a while without another one.
        """
        key = key_of(target)
        refused_at_ns = self._refused_at_ns.get(key, 0)
        if refused_at_ns:
            if sent_at_ns - refused_at_ns < REFUSAL_NS:
                return ProbeResult.ABSENT
            self._refused_at_ns[key] = 0
        if self._table is None:
            return ProbeResult.BLIND
        return self._table.look(target.host, self._source)

    def close(self) -> None:
        """Close the sockets."""
        for sock in self.sockets:
            sock.close()


class SubscriberProbes(NamedTuple):
    """All ways of an appliance, by port."""

    arp: dict[PortName, ArpProber]
    udp: dict[PortName, UdpSubscriberProbe]


class ProbeSockets:
    """Probes of all EAP ports, which follow the ports.

    Args:
        resources: Closes them.

    Attributes:
        probes: Those of the present ports.
    """

    def __init__(self, resources: ExitStack) -> None:
        self.probes = SubscriberProbes({}, {})
        self._table = _open_table(resources)
        self._udp: dict[SharedSocket, UdpSubscriberProbe] = {}
        self._arp: dict[tuple[SharedSocket, int], ArpProber] = {}
        resources.callback(self.close)

    def follow(
        self, sockets: Iterable[SharedSocket], port_of: Callable[[PortName], PortSpec]
    ) -> None:
        """Have the probes on *sockets*; *port_of* returns the specification of a port."""
        udp: dict[SharedSocket, tuple[PortName, ...]] = {}
        arp: dict[tuple[SharedSocket, int], tuple[PortName, ...]] = {}
        for shared in sockets:
            if shared.kind is SocketKind.UDP:
                udp[shared.key] = shared.owners
                if shared.key not in self._udp:
                    probe = UdpSubscriberProbe(_both(shared), self._table, shared.address)
                    self._udp[shared.key] = probe
            elif shared.kind is SocketKind.ARP:
                key = shared.key, port_of(shared.owners[0]).vlan_priority
                arp[key] = shared.owners
                if key not in self._arp:
                    self._arp[key] = _open_prober(shared, key[1])
        for gone in self._udp.keys() - udp.keys():
            self._udp.pop(gone).close()
        for left in self._arp.keys() - arp.keys():
            self._arp.pop(left).close()
        self.probes.udp.clear()
        self.probes.arp.clear()
        for socket_key, owners in udp.items():
            self.probes.udp.update(dict.fromkeys(owners, self._udp[socket_key]))
        for prober_key, owners in arp.items():
            self.probes.arp.update(dict.fromkeys(owners, self._arp[prober_key]))

    def close(self) -> None:
        """Close all."""
        for probe in self._udp.values():
            probe.close()
        for prober in self._arp.values():
            prober.close()


def _open_prober(shared: SharedSocket, priority: int) -> ArpProber:
    sock = socket.socket(fileno=os.dup(shared.services_fd))
    return ArpProber(sock, vlan_id=shared.vlan_id, priority=priority, interface=shared.address)


def _open_table(resources: ExitStack) -> NeighbourTable | None:
    try:
        table = NeighbourTable()
    except EnvironmentalError as exc:
        logger.warning("%s; missing subscribers on UDP are detected by ICMP only", exc)
        return None
    resources.callback(table.close)
    return table


def _both(shared: SharedSocket) -> list[socket.socket]:
    descriptors = shared.engine_fd, shared.services_fd
    return [socket.fromfd(fd, socket.AF_INET, socket.SOCK_DGRAM) for fd in descriptors]


def key_of(target: Destination) -> tuple[str, int]:
    """Return address and port of *target*, as ICMP errors give them."""
    return target.host, target.port or EAP_PORT


POLL_NS = 200_000_000
"""Longest period of the look for changed targets; answers wait at most as long."""


class ImageHolder(Protocol):
    """Holder of the newest image of a station."""

    @property
    def image(self) -> Image:
        """Return it; raise ImageError if there is none."""


class _Row:
    """One monitored frame, and its destination at the last look."""

    def __init__(self, port: PortName, place: FrameSlot, image: Image) -> None:
        self.name = f"{port.station}/{place.name}"
        self.port = port
        self.place = place
        self.words = image.words
        self.address = -1
        self.destination: Destination | None = None

    def word(self, word: FrameWord) -> int:
        return int(self.words[self.place.words + word])

    def has_moved(self) -> bool:
        """Read the present destination of the frame; return whether it has changed."""
        address = self.word(FrameWord.ADDRESS)
        if address == self.address:
            return False
        self.address = address
        self.destination = from_word(address)
        return True

    @property
    def target(self) -> MonitorTarget:
        mac = None
        if self.destination is not None and self.destination.kind is DestinationKind.MAC:
            mac = MacAddr.parse(self.destination.host)
        return MonitorTarget(self.name, self.place.monitor_interval_ms * 1_000_000, mac)


class SubscriberWatch:
    """Monitors the subscribers of all frames of the *images*, by station, that say so."""

    def __init__(self, images: Mapping[str, ImageHolder], endpoints: SubscriberProbes) -> None:
        self._holders = images
        self._endpoints = endpoints
        self._errors = select.epoll()
        self._errors.close()
        self._owners: dict[int, UdpSubscriberProbe] = {}
        self._images: dict[str, Image] = {}
        self._rows: dict[str, _Row] = {}
        self._monitor = SubscriberMonitor(0)
        self._pending: dict[tuple[ArpProber, IPv4Address], list[str]] = {}

    async def run(self) -> None:
        """Go on until cancelled."""
        loop = asyncio.get_running_loop()
        with select.epoll() as self._errors:
            self._register()

            def collect() -> None:
                for fd, _ in self._errors.poll(0):
                    self._owners[fd].collect(monotonic_ns())

            loop.add_reader(self._errors.fileno(), collect)
            try:
                while True:
                    pause_ns = self.step(monotonic_ns()) - monotonic_ns()
                    await asyncio.sleep(max(pause_ns, 0) / 1e9)
            finally:
                loop.remove_reader(self._errors.fileno())

    def follow(self) -> None:
        """Follow the probes, of which some are new or closed."""
        if not self._errors.closed:
            self._register()
        self._watch_targets()

    def _register(self) -> None:
        """Wait for the errors of all UDP sockets."""
        for fd in self._owners:
            with suppress(OSError):  # it is closed, and its number may be that of another socket
                self._errors.unregister(fd)
        self._owners = {
            sock.fileno(): endpoint
            for endpoint in self._endpoints.udp.values()
            for sock in endpoint.sockets
        }
        for fd in self._owners:
            # Errors alone, and each once: the frames that arrive there are for others.
            self._errors.register(fd, select.EPOLLET)

    def step(self, now_ns: int) -> int:
        """Run one step; return when the next step is due."""
        self._follow_frames(now_ns)
        self._receive_replies(now_ns)
        for name in self._monitor.probes_to_send(now_ns):
            evidence = self._probe(self._rows[name])
            if evidence is not None:
                self._monitor.receive_result(name, evidence, now_ns)
        self._publish()
        due_ns = self._monitor.next_timeout()
        return now_ns + POLL_NS if due_ns is None else min(due_ns, now_ns + POLL_NS)

    def _follow_frames(self, now_ns: int) -> None:
        """Read which frames are monitored and their destinations."""
        changed = False
        for station, holder in self._holders.items():
            try:
                image = holder.image
            except ImageError:
                continue  # between two images: the next look will find one
            if self._images.get(station) is not image:
                self._images[station] = image
                self._replace(station, image)
                changed = True
        for row in self._rows.values():
            if row.has_moved():
                self._monitor.add(row.target, now_ns)
                changed = True
        if changed:
            self._watch_targets()

    def _replace(self, station: str, image: Image) -> None:
        """Follow the frames of *image*; the evidence about unchanged frames is kept."""
        own = [name for name, row in self._rows.items() if row.port.station == station]
        before = {name: self._rows.pop(name) for name in own}
        for place in image.layout.frames:
            if place.monitor_interval_ms:
                row = _Row(PortName(station, place.port), place, image)
                was = before.get(row.name)
                if was is not None and was.place.target == place.target:
                    row.address, row.destination = was.address, was.destination
                self._rows[row.name] = row
        for name in before.keys() - self._rows.keys():
            self._monitor.remove(name)

    def _watch_targets(self) -> None:
        """Set the filters of each probe to its targets."""
        self._pending = {}
        targets: dict[UdpSubscriberProbe, list[Destination]] = {}
        for row in self._rows.values():
            if hop_prober := self._hop_prober(row):
                key = hop_prober, IPv4Address(row.place.monitor_ip)
                self._pending.setdefault(key, []).append(row.name)
            endpoint = self._endpoints.udp.get(row.port)
            if endpoint is not None and (target := _ip_of(row)) is not None:
                targets.setdefault(endpoint, []).append(target)
        for endpoint in set(self._endpoints.udp.values()):
            endpoint.watch(targets.get(endpoint, ()))
        for hop_prober in set(self._endpoints.arp.values()):
            try:
                hop_prober.watch(address for each, address in self._pending if each is hop_prober)
            except EnvironmentalError as exc:
                logger.warning("%s", exc)

    def _receive_replies(self, now_ns: int) -> None:
        for hop_prober in set(self._endpoints.arp.values()):
            for reply in hop_prober.drain():
                for name in self._pending.get((hop_prober, reply.address), ()):
                    if reply.is_claim:
                        self._monitor.receive_claim(name, reply.mac, now_ns)
                    else:
                        self._monitor.receive_reply(name, reply.mac, now_ns)
        refused = {
            endpoint: endpoint.refused_targets(now_ns)
            for endpoint in set(self._endpoints.udp.values())
        }
        for row in self._rows_by_udp():
            target = _ip_of(row)
            if target is not None and key_of(target) in refused[self._endpoints.udp[row.port]]:
                self._monitor.receive_result(row.name, ProbeResult.ABSENT, now_ns)

    def _rows_by_udp(self) -> Iterator[_Row]:
        return (row for row in self._rows.values() if row.port in self._endpoints.udp)

    def _probe(self, row: _Row) -> ProbeResult | None:
        """Probe the subscriber of *row*; return evidence known at once, None if it may answer."""
        if hop_prober := self._hop_prober(row):
            return (
                None if hop_prober.probe(IPv4Address(row.place.monitor_ip)) else ProbeResult.BLIND
            )
        target, endpoint = _ip_of(row), self._endpoints.udp.get(row.port)
        if target is None or endpoint is None:
            return ProbeResult.BLIND
        return endpoint.evidence_of(target, row.word(FrameWord.SENT_AT_NS))

    def _hop_prober(self, row: _Row) -> ArpProber | None:
        """Return the ARP prober for the subscriber of *row*, None where ARP cannot reach it."""
        destination = row.destination
        if destination is None or destination.kind is not DestinationKind.MAC:
            return None
        if destination.is_group or not row.place.monitor_ip:
            return None
        return self._endpoints.arp.get(row.port)

    def _publish(self) -> None:
        while event := self._monitor.next_event():
            _log_change(event, self._rows[event.name])
        for row in self._rows.values():
            row.words[row.place.words + FrameWord.PRESENCE] = self._monitor.presence(row.name)


def _ip_of(row: _Row) -> Destination | None:
    """Return the destination of a unicast frame on UDP, None for all others."""
    target = row.destination
    if target is None or target.kind is not DestinationKind.IP or target.is_group:
        return None
    return target


def _log_change(event: PresenceChanged, row: _Row) -> None:
    level = logging.WARNING if event.new is SubscriberPresence.MISSING else logging.INFO
    other = ""
    if event.new is SubscriberPresence.MISSING and event.answered_by not in {None, row.target.mac}:
        other = f"; {row.place.monitor_ip} is answered by {event.answered_by} instead"
    logger.log(
        level,
        "%s: subscriber at %s is %s%s",
        event.name,
        row.destination,
        event.new.name.lower()
        if event.new is not SubscriberPresence.UNKNOWN
        else "no longer observable",
        other,
    )
