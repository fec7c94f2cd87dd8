"""Frames that a recording is replayed by, and the times at which they are sent.

A recording of frames is sent as it was recorded.  Of a recording of values, the frames of the plant
are made again: a PD that is sent by a schedule at its period, any other one when its data changes.
Nothing here sends or waits.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from eap.codec.pd import (
    CYCLE_OFFSET,
    PD_FRAME_START,
    PdFrameHeader,
    PdHeader,
    encode_frame,
)
from eap.errors import ConfigError
from eap.ids import NetId
from eap.patterns import compile_patterns
from eap.recording.frames_reader import FramesFile
from eap.recording.messages import Leaf, write_leaf
from eap.recording.published import RecordedFrame, RecordedPd
from eap.recording.rows import ALL, ValueRow
from eap.suggest import suggest

if TYPE_CHECKING:
    from eap.recording.values_reader import ValuesFile

_PUBLISHER = slice(PD_FRAME_START, PD_FRAME_START + 6)
_CYCLE = slice(CYCLE_OFFSET, CYCLE_OFFSET + 2)
_LONE_NS = 1_000_000_000
"""Time of a round of a recording that has a single moment."""


class ReplaySender(NamedTuple):
    """Port that frames are sent by: its station, name, interface and NetID."""

    station: str
    port: str
    interface: str
    publisher: str


class ReplayFrame(NamedTuple):
    """One frame: *data* begins at the EtherCAT header, *packet* at the Ethernet header if known."""

    at_ns: int
    sender: ReplaySender
    destination: str
    data: bytes
    packet: bytes
    names: tuple[str, ...]
    """Names of its PDs."""


@dataclass(slots=True)
class ReplayRow:
    """Frames of one sender to one destination, for people."""

    sender: ReplaySender
    destination: str
    names: tuple[str, ...]
    frames: int = 0
    first_ns: int = 0
    last_ns: int = 0


@dataclass(slots=True)
class ReplayPlan:
    """All frames of a replay, by sender, and what cannot be sent with its reason."""

    senders: dict[str, ReplaySender] = field(default_factory=dict)
    rows: dict[tuple[str, str, tuple[str, ...]], ReplayRow] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)

    def add(self, frame: ReplayFrame) -> None:
        """Count one frame."""
        sender = frame.sender
        self.senders[sender.publisher] = sender
        key = sender.publisher, frame.destination, frame.names
        row = self.rows.get(key)
        if row is None:
            row = ReplayRow(sender, frame.destination, frame.names, first_ns=frame.at_ns)
            self.rows[key] = row
        row.frames += 1
        row.last_ns = frame.at_ns


def frames_of(
    recording: FramesFile | ValuesFile, left_out: dict[str, str], only: str = ""
) -> Iterator[ReplayFrame]:
    """Yield the frames of a recording that *only* matches, in order.

    *only* is a pattern of a station, ``STATION/PORT``, ``STATION/PD`` or publisher.  What cannot be
    sent is noted in *left_out* with its reason.
    """
    source = (
        _recorded(recording, left_out)
        if isinstance(recording, FramesFile)
        else _made(recording, left_out)
    )
    fits = compile_patterns([only or "*"])
    for frame in source:
        if any(map(fits, _names(frame))):
            yield frame


def _names(frame: ReplayFrame) -> Iterator[str]:
    sender = frame.sender
    yield sender.station
    yield f"{sender.station}/{sender.port}"
    yield sender.publisher
    for name in frame.names:
        yield f"{sender.station}/{name}"


def senders_of(published: Iterable[RecordedFrame]) -> dict[str, ReplaySender]:
    """Return the port of each publisher of a plant."""
    return {
        each.publisher: ReplaySender(each.station, each.port, each.interface, each.publisher)
        for each in published
    }


def _recorded(recording: FramesFile, left_out: dict[str, str]) -> Iterator[ReplayFrame]:
    senders = senders_of(recording.published)
    interfaces = set(recording.interfaces)
    taken_from = {
        publisher: f"{each.station}/{each.port}"
        for publisher, each in senders.items()
        if f"{each.station}/{each.port}" in interfaces
    }
    for captured, packet, data in recording.frames(once=True):
        found = recording.pds_of(data)
        if found is None:
            continue
        publisher, _, pds = found
        name = recording.interfaces[captured.interface]
        # A frame is recorded where it was sent and where it was received: it is sent once.
        if taken_from.setdefault(publisher, name) != name:
            continue
        sender = senders.get(publisher)
        if sender is None:
            left_out[publisher] = "the plant in the recording has no such publisher"
            continue
        names = tuple(
            recording.name_of(source).partition("/")[2] for source, _ in pds if source is not None
        )
        yield ReplayFrame(captured.at_ns, sender, packet.destination, data, captured.octets, names)


class _MadePd:
    """One PD of a recording of values: the places of its values, and its last data."""

    def __init__(self, pd: RecordedPd, leaves: list[tuple[int, Leaf]]) -> None:
        self.pd = pd
        self._leaves = leaves
        self._last: bytes | None = None
        self._sent_ns = 0

    def data(self, row: ValueRow) -> bytes:
        """Return the bytes of the PD."""
        octets = bytearray(self.pd.size)
        for position, leaf in self._leaves:
            write_leaf(leaf, octets, row.values[position])
        return bytes(octets)

    def is_due(self, row: ValueRow, data: bytes, tolerance_ns: int) -> bool:
        """Return whether the PD is sent with *row*, and note it."""
        period_ns = 1000 * self.pd.period_us
        if self._last is not None and (
            row.time_ns - self._sent_ns < period_ns - tolerance_ns
            if period_ns
            else data == self._last
        ):
            return False
        self._last, self._sent_ns = data, row.time_ns
        return True


def _made(recording: ValuesFile, left_out: dict[str, str]) -> Iterator[ReplayFrame]:
    plans: dict[int, list[tuple[RecordedFrame, list[_MadePd]]]] = {}
    for source, found in recording.sources.items():
        places = {column.name: place for place, column in enumerate(found.columns)}
        plans[source] = [
            (frame, pds)
            for frame in recording.published
            if frame.station == found.station and (pds := _made_pds(frame, places, left_out))
        ]
    senders = senders_of(recording.published)
    last_ns: dict[int, int] = {}
    for row in recording.rows(ALL, {source for source, frames in plans.items() if frames}):
        # Samples lie beside the times at which PDs were sent, by up to half a step.
        tolerance_ns = max(0, row.time_ns - last_ns.get(row.source, row.time_ns)) // 2
        last_ns[row.source] = row.time_ns
        for frame, pds in plans[row.source]:
            due = []
            for each in pds:
                data = each.data(row)
                if each.is_due(row, data, tolerance_ns):
                    due.append((PdHeader(each.pd.pd_id, each.pd.version, 0, 0), data))
            if due:
                publisher = NetId.parse(frame.publisher)
                header = PdFrameHeader(publisher, len(due), row.cycle & 0xFFFF)
                names = tuple(each.pd.name for each in pds)
                yield ReplayFrame(
                    row.time_ns,
                    senders[frame.publisher],
                    frame.destination,
                    encode_frame(header, due),
                    b"",
                    names,
                )


def _made_pds(
    frame: RecordedFrame, places: Mapping[str, int], left_out: dict[str, str]
) -> list[_MadePd]:
    from eap.recording.messages import StationMessages

    found = []
    for pd in frame.pds:
        leaves = StationMessages(frame.station, pd.placed()).leaves
        named = [(places.get(f"{frame.station}/{leaf.path}"), leaf) for leaf in leaves]
        missing = [leaf.path for place, leaf in named if place is None]
        if missing:
            left_out[f"{frame.station}/{pd.name}"] = f"{missing[0]} was not recorded"
        else:
            found.append(_MadePd(pd, [(place or 0, leaf) for place, leaf in named]))
    return found


def impersonate(
    frames: Iterable[ReplayFrame], station: str, senders: Mapping[str, ReplaySender]
) -> Iterator[ReplayFrame]:
    """Yield *frames* of one station as those of *station*, with the NetID of its port.

    Raises:
        ConfigError: the plant has no such station, or the frames are those of several stations.
    """
    ports = [each for each in senders.values() if each.station == station]
    if not ports:
        known = sorted({each.station for each in senders.values()})
        raise ConfigError(f"--as: unknown station {station!r}{suggest(station, known)}")
    original = ""
    for frame in frames:
        # One station cannot have the cycle counters of several.
        original = original or frame.sender.station
        if frame.sender.station != original:
            raise ConfigError(
                f"--as: frames of {original} and {frame.sender.station}: choose those of one"
                " station with --only"
            )
        named = [each for each in ports if each.port == frame.sender.port]
        sender = (named or ports)[0]
        data = bytearray(frame.data)
        data[_PUBLISHER] = NetId.parse(sender.publisher)
        packet = frame.packet[: len(frame.packet) - len(data)] + data if frame.packet else b""
        yield frame._replace(sender=sender, data=bytes(data), packet=bytes(packet))


class ReplayClock:
    """Times at which frames are sent: *rate* times as fast, again and again with *is_loop*.

    The cycle counters of all publishers go on over the end of a round, so that subscribers count
    no frame as lost or repeated.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._first_ns: int | None = None
        self._start_ns = 0
        self._span_ns = 0
        self._step_ns = 0
        self._cycles: dict[str, int] = {}
        self._steps: dict[str, int] = {}
        self._shifts: dict[str, int] = {}
        self._is_first_of: set[str] = set()

    def begin_round(self, now_ns: int) -> None:
        """Begin at *now_ns*, or behind the end of the last round."""
        if self._first_ns is None:
            self._start_ns = now_ns
        else:
            # The next round begins one step behind the last frame, as if the recording went on.
            self._start_ns += round((self._span_ns + self._step_ns or _LONE_NS) / self._rate)
            self._is_first_of = set(self._cycles)
        self._first_ns = None
        self._span_ns = 0

    def due_ns(self, frame: ReplayFrame) -> int:
        """Return when *frame* is to be sent."""
        if self._first_ns is None:
            self._first_ns = frame.at_ns
        passed_ns = frame.at_ns - self._first_ns
        if passed_ns > self._span_ns:
            self._step_ns = passed_ns - self._span_ns
            self._span_ns = passed_ns
        return self._start_ns + round(passed_ns / self._rate)

    def numbered(self, frame: ReplayFrame) -> bytes:
        """Return the data of *frame* with the cycle counter of this round."""
        publisher = frame.sender.publisher
        recorded = int.from_bytes(frame.data[_CYCLE], "little")
        before = self._cycles.get(publisher)
        if before is not None and publisher in self._is_first_of:
            self._is_first_of.discard(publisher)
            # Subscribers count a jump of the cycle counter as lost PDs.
            self._shifts[publisher] = (before + self._steps.get(publisher, 1) - recorded) & 0xFFFF
        cycle = (recorded + self._shifts.get(publisher, 0)) & 0xFFFF
        if before is not None and cycle != before:
            self._steps[publisher] = (cycle - before) & 0xFFFF
        self._cycles[publisher] = cycle
        if cycle == recorded:
            return frame.data
        data = bytearray(frame.data)
        data[_CYCLE] = cycle.to_bytes(2, "little")
        return bytes(data)
