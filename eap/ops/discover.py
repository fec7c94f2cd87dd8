"""Discovery of process data on a network: frames of an interface or of a capture, as rows.

The observer (``eap.pd.observer``) sees frames only; here they come from a driver or from a file,
and each PD that it finds is compared with the subscriptions of plants.
"""

from __future__ import annotations

import select
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from time import monotonic
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from eap.codec import datatypes
from eap.codec.ethercat import EAP_PORT
from eap.control.device import EXPORT
from eap.errors import ControlError
from eap.ids import NetId
from eap.net.capture import FrameCapture
from eap.ops.client import connect_those
from eap.pd.appearance import guess
from eap.pd.observer import MAX_PDS, ObservedPath, ObservedPd, ObservedPdKey, Observer
from eap.pd.rhythm import CycleOrder
from eap.pd.spec import PortKind, PortSpec, RxPdSpec, StationSpec
from eap.pd.words import PdDropReason, Reason
from eap.recording.packets import Packet, capture_drops, iter_capture, unwrap

if TYPE_CHECKING:
    from eap.ops.publisher_dictionary import PublishedPd  # which loads clients of dictionaries

_UDP_START = 42
"""Offset of a datagram's payload behind Ethernet, IPv4 without options, and UDP."""
_ETHERCAT, _PLAIN_IPV4 = b"\x88\xa4", b"\x08\x00\x45"
_FRAGMENT = 0x3FFF
"""More fragments follow, or an offset."""
_MAX_PATHS = 4096
_TICK_S = 0.2


class RefusedBy(Struct, frozen=True):
    """Subscription of the same PD ID that drops the PD, and why."""

    entry: str
    reason: str


class DiscoveredVariable(Struct, frozen=True):
    """Variable of a PD by the publisher's own dictionary."""

    name: str
    type: str


class DiscoveredPd(Struct, frozen=True, kw_only=True):
    """``eapctl discover``: one PD on the network.

    Attributes:
        publisher: NetID in its frames.
        pd_id: PD id.
        version: Version of its layout.
        length: Bytes of data.
        rate_hz: Arrivals a second, None of a single one.
        jitter_us: 99th percentile of the deviation from the rhythm, None without one.
        destination: MAC or IPv4 address that it goes to, with a UDP port other than 34980.
        taken_by: Subscriptions that take it, ``STATION/PD``; None if there is none.
        name: Of the PD, by the publisher's dictionary; None while that was not asked.
        variables: Likewise; also None where the dictionary describes another layout.
        transport: ``ethernet``, ``udp`` or ``tcp``; empty where it was not seen nor told.
        destination_kind: ``unicast``, ``multicast`` or ``broadcast``.
        vlan_id: Of a tagged frame.
        sources: Addresses that it came from.
        received: Arrivals.
        age_ms: Time since the last one.
        jitter_max_us: Largest deviation.
        trigger: Guess: cycle, change, change_timeout, event or poll; None while too few arrived.
        period_ms: Of a cyclic PD.
        timeout_ms: Of ``change_timeout``: unchanged data comes again after it.
        sender_cycle_us: Device cycle of the sender, None if unknown.
        step: Sender cycles between two arrivals, None if there is no fixed number.
        missed: Arrivals that the cycle counter shows to be missing, among the latest ones.
        repeated: Arrivals with cycle counter and toggle bit of the one before.
        cycle_order: ``little``, ``swapped``, ``constant`` or ``unknown``.
        header_length: Length of the EtherCAT header where that is wrong.
        quality: Of the last arrival, in units of 100 us.
        refused_by: Subscriptions of the same PD ID that drop it.
        looks_like: Guess of its content.
    """

    publisher: str
    pd_id: int
    version: int
    length: int
    rate_hz: float | None
    jitter_us: int | None
    destination: str
    taken_by: str | None
    name: str | None = None
    variables: list[DiscoveredVariable] | None = None
    transport: str = ""
    destination_kind: str = ""
    vlan_id: int | None = None
    sources: list[str] = []
    received: int = 0
    age_ms: int | None = None
    jitter_max_us: int | None = None
    trigger: str | None = None
    period_ms: float | None = None
    timeout_ms: int | None = None
    sender_cycle_us: int | None = None
    step: int | None = None
    missed: int = 0
    repeated: int = 0
    cycle_order: str = CycleOrder.UNKNOWN.value
    header_length: int | None = None
    quality: int | None = None
    refused_by: list[RefusedBy] = []
    looks_like: list[str] = []

    @property
    def key(self) -> tuple[str, int]:
        """Publisher and PD ID."""
        return self.publisher, self.pd_id


class CaptureLosses(NamedTuple):
    """Packets and frames that the capture did not see, or could not read."""

    dropped: int | None
    """Packets that the kernel or the capturing program dropped; None where that is not known."""
    cut: int
    """Frames of which only the begin was there."""
    malformed: int
    not_kept: int
    """PDs beyond the limit of the observer."""
    errors: Mapping[str, int] = MappingProxyType({})
    """Failed system calls by errno name: ENETDOWN when the interface went down or away."""

    def lines(self) -> Iterator[str]:
        """Yield a line for each kind of loss."""
        if self.dropped:
            yield f"capture: {self.dropped} packets lost: too fast; rates and gaps are wrong"
        for name, number in self.errors.items():
            why = "interface down" if name == "ENETDOWN" else name
            yield f"capture: {why}, {'once' if number == 1 else f'{number} times'}"
        if self.cut:
            yield f"capture: {self.cut} frames with their begin only: in fragments, or cut"
        if self.malformed:
            yield f"capture: {self.malformed} frames malformed: their PDs reach past their end"
        if self.not_kept:
            yield f"capture: {self.not_kept} PDs not kept: more than {MAX_PDS} at a time"


class ObserverFeed:
    """Observer fed by a source of frames.

    Attributes:
        observer: The PDs seen so far.
        now_ns: Time of the latest packet or look, on the clock of the capture.
    """

    def __init__(self) -> None:
        self.observer = Observer()
        self.now_ns = 0
        self._paths: dict[tuple[bytes, int], ObservedPath] = {}
        self._dropped: int | None = None
        self._errors: Mapping[str, int] = {}

    @property
    def losses(self) -> CaptureLosses:
        """Losses so far."""
        seen = self.observer
        return CaptureLosses(self._dropped, seen.cut, seen.malformed, seen.not_kept, self._errors)

    def watch(self, interface: str, for_s: float | None) -> Iterator[None]:
        """Capture at *interface* for *for_s* seconds, or without end; yield now and then.

        Raises:
            EnvironmentalError: the interface cannot be opened.
        """
        end_s = None if for_s is None else monotonic() + for_s
        with closing(FrameCapture(interface)) as capture:
            poll = select.poll()
            poll.register(capture.fileno(), select.POLLIN)
            self._errors = capture.errors
            while True:
                left_s = _TICK_S if end_s is None else min(_TICK_S, end_s - monotonic())
                if left_s <= 0:
                    return
                look_s = monotonic() + left_s
                while (wait_s := look_s - monotonic()) > 0:
                    if poll.poll(wait_s * 1000):
                        capture.drain(self.receive_packet)
                self.now_ns = round(monotonic() * 1e9)
                self._dropped = capture.dropped
                yield

    def read(self, path: Path) -> None:
        """Take all frames of a pcap or pcapng file.

        Raises:
            OSError: the file cannot be read.
            MalformedError: it is no capture of Ethernet, or is damaged; the frames before count.
        """
        self._dropped = capture_drops(path)
        for frame in iter_capture(path):
            self.now_ns = frame.at_ns
            self.observer.receive_frame(frame.data, frame.at_ns, frame_path(frame.packet))

    def receive_packet(self, octets: memoryview, at_ns: int, tci: int) -> None:
        """Take one packet of a capture; *tci* is the VLAN tag that the kernel took out, or 0."""
        # The bytes that a packet's path depends on; other forms (a tag in the packet, options,
        # fragments) are rare and taken apart each time.
        kind = octets[12:14]
        if kind == _ETHERCAT:
            head, start, end = bytes(octets[:14]), 14, None
        elif octets[12:15] == _PLAIN_IPV4 and not int.from_bytes(octets[20:22]) & _FRAGMENT:
            head, start = bytes(octets[:14]) + bytes(octets[26:38]), _UDP_START
            end = 14 + int.from_bytes(octets[16:18])
        else:
            self._receive_unusual(octets, at_ns, tci)
            return
        path = self._paths.get((head, tci))
        if path is None:
            packet = unwrap(bytes(octets))
            if packet is None:
                return
            path = _tagged(frame_path(packet), tci)
            # Source addresses can be invented: the memory of paths is bounded.
            if len(self._paths) >= _MAX_PATHS:
                self._paths.clear()
            self._paths[head, tci] = path
        self.observer.receive_frame(octets[start:end], at_ns, path)

    def _receive_unusual(self, octets: memoryview, at_ns: int, tci: int) -> None:
        packet = unwrap(bytes(octets))
        if packet is not None:
            self.observer.receive_frame(packet.payload, at_ns, _tagged(frame_path(packet), tci))


def _tagged(path: ObservedPath, tci: int) -> ObservedPath:
    """Return *path* with the VLAN of a tag that the kernel took out."""
    return path._replace(vlan_id=tci & 0xFFF) if tci and path.vlan_id is None else path


def frame_path(packet: Packet) -> ObservedPath:
    """Return the path of a packet, with port numbers only where they are not the usual one."""
    if packet.transport == "ethernet":
        return ObservedPath(packet.transport, packet.source, packet.destination, packet.vlan_id)
    source, destination = (
        host if int(port) == EAP_PORT else f"{host}:{port}"
        for host, _, port in (each.partition(":") for each in (packet.source, packet.destination))
    )
    return ObservedPath(packet.transport, source, destination, packet.vlan_id)


def discovered(
    discovery: ObserverFeed, takers: Iterable[Taker], *, with_guess: bool = True
) -> list[DiscoveredPd]:
    """Return a row for each PD, by publisher and ID; the guess of its content takes longest."""
    by_id: dict[int, list[Taker]] = {}
    for taker in takers:
        by_id.setdefault(taker.subscription.pd_id, []).append(taker)
    rows = [
        _row(each, by_id.get(each.key.pd_id, ()), discovery.now_ns, with_guess=with_guess)
        for each in discovery.observer.pds.values()
    ]
    return sorted(rows, key=_row_order)


def _row_order(row: DiscoveredPd) -> tuple[list[int], int, str]:
    return [int(part) for part in row.publisher.split(".")], row.pd_id, row.destination


def _compare(key: ObservedPdKey, takers: Iterable[Taker]) -> tuple[str | None, list[RefusedBy]]:
    """Return the subscriptions that take a PD, or those that drop it."""
    taking, refusing = [], []
    for each in takers:
        if each.subscription.pd_id != key.pd_id:
            continue
        reason = each.refusal(key)
        if reason is None and each.is_reached(key):
            taking.append(each.name)
        elif reason is None:
            refusing.append(RefusedBy(each.name, NOT_REACHED))
        # A PD of another publisher that does not even arrive there is no near miss.
        elif reason is not PdDropReason.WRONG_PUBLISHER or each.is_reached(key):
            refusing.append(RefusedBy(each.name, reason.value))
    return ", ".join(taking) or None, [] if taking else refusing


def _row(pd: ObservedPd, takers: Iterable[Taker], now_ns: int, *, with_guess: bool) -> DiscoveredPd:
    key, found = pd.key, pd.measure()
    taken_by, refused_by = _compare(key, takers)
    return DiscoveredPd(
        publisher=str(pd.publisher),
        pd_id=key.pd_id,
        version=key.version,
        length=key.length,
        rate_hz=None if found.rate_hz is None else round(found.rate_hz, 3),
        jitter_us=found.jitter_us,
        destination=key.destination,
        taken_by=taken_by,
        transport=key.transport,
        destination_kind=key.destination_kind,
        vlan_id=key.vlan_id,
        sources=list(pd.sources),
        received=pd.rhythm.received,
        age_ms=max(0, now_ns - pd.rhythm.last_ns) // 1_000_000,
        jitter_max_us=found.jitter_max_us,
        trigger=found.trigger and found.trigger.value,
        period_ms=found.period_us / 1000 if found.period_us else None,
        timeout_ms=found.timeout_ms if found.trigger is Reason.CHANGE_TIMEOUT else None,
        sender_cycle_us=found.sender_cycle_us or None,
        step=found.step or None,
        missed=found.missed,
        repeated=pd.repeated,
        cycle_order=pd.cycle.order.value,
        header_length=pd.wrong_length,
        quality=pd.quality,
        refused_by=refused_by,
        looks_like=[str(part) for part in guess(pd.samples)] if with_guess else [],
    )


def complete(
    rows: Iterable[DiscoveredPd], published: Sequence[PublishedPd], takers: Sequence[Taker]
) -> tuple[list[DiscoveredPd], list[str]]:
    """Return *rows* with names and types of dictionaries, and what does not fit, in words.

    A PD that no frame brought is a row as well, compared with *takers*.
    """
    by_key = {(pd.publisher, pd.pd_id): pd for pd in published}
    found, remarks = [], []
    for row in rows:
        known = by_key.get(row.key)
        if known is None:
            found.append(row)
            continue
        variables = None
        # Names of another layout would stand beside the wrong bytes.
        if (known.version, known.length) == (row.version, row.length):
            variables = _variables(known)
        else:
            remarks.append(
                f"PD {row.pd_id} of {row.publisher}: seen with version {row.version} and "
                f"{row.length} bytes, but its dictionary describes version {known.version} with "
                f"{known.length} bytes"
            )
        found.append(replace(row, name=known.name, variables=variables))
    seen = {row.key for row in found}
    found += [_unseen(pd, takers) for key, pd in by_key.items() if key not in seen]
    return sorted(found, key=_row_order), remarks


def _unseen(pd: PublishedPd, takers: Iterable[Taker]) -> DiscoveredPd:
    publisher = NetId.parse(pd.publisher)
    key = ObservedPdKey(
        publisher, pd.pd_id, pd.version, pd.length, pd.transport, pd.destination, vlan_id=None
    )
    taken_by, refused_by = _compare(key, takers) if pd.transport else (None, [])
    return DiscoveredPd(
        publisher=pd.publisher,
        pd_id=pd.pd_id,
        version=pd.version,
        length=pd.length,
        rate_hz=None,
        jitter_us=None,
        destination=pd.destination,
        taken_by=taken_by,
        refused_by=refused_by,
        name=pd.name,
        variables=_variables(pd),
        transport=pd.transport,
        destination_kind=key.destination_kind if pd.transport else "",
        trigger=Reason.CYCLE.value if pd.cycle_us else None,
        period_ms=pd.cycle_us / 1000 if pd.cycle_us else None,
    )


def _variables(pd: PublishedPd) -> list[DiscoveredVariable]:
    return [DiscoveredVariable(*each) for each in pd.variables]


NOT_REACHED = "other_destination"
"""Reason of a subscription whose port does not get frames to the PD's destination."""


class Taker(NamedTuple):
    """One subscription of a station."""

    station: str
    port: PortSpec
    subscription: RxPdSpec
    layouts: frozenset[tuple[int, int]]
    """Version and length of each layout that it takes, the usual one included."""
    length: int

    @property
    def name(self) -> str:
        """``STATION/PD``, as the plant file and ``eapctl status`` name it."""
        return f"{self.station}/{self.subscription.name}"

    def refusal(self, pd: ObservedPdKey) -> PdDropReason | None:
        """Return the reason for which this subscription drops *pd*, None if it takes it."""
        wanted = self.subscription
        # In the order in which a subscriber checks a PD, so that the reason is that of its counter.
        if wanted.publisher and NetId.parse(wanted.publisher) != pd.publisher:
            return PdDropReason.WRONG_PUBLISHER
        if (pd.version, pd.length) in self.layouts:
            return None
        if pd.version != wanted.version and not wanted.ignore_version:
            return PdDropReason.VERSION
        return None if pd.length == self.length else PdDropReason.LENGTH

    def is_reached(self, pd: ObservedPdKey) -> bool:
        """Return whether frames to the destination of *pd* can arrive at its port.

        The host's own MAC addresses are not known here: any counts as reached.
        """
        uri = self.port.interface
        if uri.scheme == "loop":
            return False
        if pd.transport == "ethernet":
            return uri.scheme == "ethernet" and self.port.vlan_id == (pd.vlan_id or 0)
        if uri.scheme not in {"udp", "tcp"}:
            return False
        host, _, number = pd.destination.partition(":")
        if int(number or EAP_PORT) != (uri.port or EAP_PORT):
            return False
        # Which groups a host has joined cannot be seen from outside.
        is_group = pd.destination_kind != "unicast"
        return is_group or uri.host in {host, "0.0.0.0"}  # noqa: S104  a comparison


def takers_of(stations: Iterable[StationSpec]) -> list[Taker]:
    """Return all subscriptions of *stations*."""
    found = []
    for station in stations:
        ports = {port.name: port for port in station.ports if port.kind is PortKind.EAP}
        types = {each.name: each.type for each in station.variables}
        for each in station.subscriptions:
            size = _size([types[name] for name in each.variables])
            layouts = {(each.version, size)}
            layouts |= {
                (alternate.version, _size([variable.type for variable in alternate.variables]))
                for alternate in each.alternates
            }
            port = ports[each.port]
            found.append(Taker(station.name, port, each, frozenset(layouts), size))
    return found


def _size(types: Sequence[str]) -> int:
    return datatypes.layout([datatypes.parse(each) for each in types]).size


def running_stations() -> tuple[list[StationSpec], list[ControlError]]:
    """Return all stations that run on this host, and the errors of appliances without an answer."""
    found: list[StationSpec] = []
    errors: list[ControlError] = []
    try:
        clients = connect_those(lambda _: True)
    except ControlError as exc:
        return [], [exc]
    for client in clients:
        with client:
            try:
                names = client.info.stations
                found += [client.call(EXPORT, station=name).spec for name in names]
            except ControlError as exc:
                errors.append(exc)
    return found, errors
