"""Frames of a pcapng file, and the values in them by the PDs of the plant."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import msgspec

from eap.codec.ethercat import FrameType
from eap.codec.pd import PD_FRAME_START, PdFrameHeader, iter_pds
from eap.errors import CodecError, MalformedError
from eap.recording.capture_file import ETHERNET, CaptureFile, CapturePacket
from eap.recording.frames_writer import (
    EVENT_COMMENT,
    FILE_COMMENT,
    HEADER_COMMENT,
    PUBLISHED_COMMENT,
)
from eap.recording.header import AttachedFile, EventKind, RecordingEvent, check_format
from eap.recording.messages import PlacedVariable, StationMessages, read_leaf
from eap.recording.packets import Packet, cut_frames, unwrap
from eap.recording.published import RecordedFrame, RecordedPd, decode_published
from eap.recording.rows import ALL, RawRow, TimeWindow, ValueRow, ValueSource, source_of

_BY_PD = tuple[str, int, int, int]
"""Publisher, ID, version and size of a PD."""


class FramePacket(NamedTuple):
    """One frame of a recording: *data* begins at the EtherCAT header."""

    captured: CapturePacket
    packet: Packet
    data: bytes


class FramesFile:
    """One recording of frames, or a capture of another program.

    The file is read once when it is opened, for its times and events.

    Args:
        path: A pcap or pcapng file.
        published: PDs of a plant, for a file that has none.

    Attributes:
        facts: Plant, host and options of the recorder; empty for captures of others.
        sources: PDs with their variables.
        files: Files of the plant.
        published: PDs of the plant.
        events: Marks and losses, in order.
        described: Interfaces of the file.
        interfaces: Their names.
        messages: Number of packets.
        first_ns: Time of the first packet, None if there is none.
        last_ns: Time of the last packet.
        is_finished: False if the file ends within a block.

    Raises:
        OSError: the file cannot be read.
        MalformedError: it is no capture of Ethernet.
    """

    def __init__(self, path: Path, published: Iterable[RecordedFrame] = ()) -> None:
        self.path = path
        self.messages = 0
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.events: list[RecordingEvent] = []
        self.is_finished = True
        self._lost: int | None = None
        with path.open("rb") as file:
            capture = CaptureFile(file, str(path))
            self._scan(capture)
        self.described = tuple(capture.interfaces)
        self.interfaces = [each.name for each in capture.interfaces]
        self.facts, self.files, inside = _section(capture.comments, path)
        self.published = tuple(published) or inside
        self.sources: dict[int, ValueSource] = {}
        self._messages: list[StationMessages] = []
        self._placed: list[tuple[str, RecordedPd]] = []
        self._pds: dict[_BY_PD, int] = {}
        self._own: dict[str, str] = {}
        for frame in self.published:
            self._own[frame.publisher] = f"{frame.station}/{frame.port}"
            for pd in frame.pds:
                self._add_pd(frame, pd)

    @property
    def lost(self) -> int:
        """Frames that the recorder did not get."""
        told = sum(each.count for each in self.events if each.kind is EventKind.LOST)
        # Events and the statistics of the interfaces tell of the same losses.
        return max(told, self._lost or 0)

    @property
    def damaged_chunks(self) -> int:
        """None: a frame is read or it is not there."""
        return 0

    def frames(self, *, once: bool = False) -> Iterator[FramePacket]:
        """Yield all frames in the order of the file.

        With *once*, received frames are left out where the ports of all senders were recorded.
        """
        # A frame that one station sent to another was recorded at both ports.
        leaves_out = once and bool(self._own) and set(self._own.values()) <= set(self.interfaces)
        with self.path.open("rb") as file:
            for captured in _tolerant(CaptureFile(file, str(self.path))):
                if leaves_out and captured.outbound is False:
                    continue
                packet = unwrap(captured.octets)
                if packet is None:
                    continue
                if packet.segment is None:
                    yield FramePacket(captured, packet, packet.payload)
                    continue
                for data in cut_frames(bytearray(packet.payload)):
                    yield FramePacket(captured, packet, data)

    def rows(
        self, window: TimeWindow = ALL, sources: Collection[int] | None = None
    ) -> Iterator[ValueRow]:
        """Yield the values of the PDs *sources* (all of them) in a time window."""
        for at_ns, source, cycle, data in self.raw_rows(window, sources):
            values = [read_leaf(leaf, data) for leaf in self._messages[source].leaves]
            yield ValueRow(at_ns, source, cycle, values)

    def raw_rows(
        self, window: TimeWindow = ALL, sources: Collection[int] | None = None
    ) -> Iterator[RawRow]:
        """Yield the data of the PDs *sources*, in the order of the file.

        A frame that several ports recorded counts once: as its sender's port sent it, else as the
        first port received it.
        """
        interfaces = set(self.interfaces)
        taken_from = {
            publisher: port for publisher, port in self._own.items() if port in interfaces
        }
        for captured, _, data in self.frames(once=True):
            if captured.at_ns not in window or (frame := self.pds_of(data)) is None:
                continue
            publisher, cycle, pds = frame
            name = self.interfaces[captured.interface]
            if taken_from.setdefault(publisher, name) != name:
                continue
            for source, content in pds:
                if source is not None and (sources is None or source in sources):
                    yield RawRow(captured.at_ns, source, cycle, content)

    def pds_of(self, data: bytes) -> tuple[str, int, list[tuple[int | None, bytes]]] | None:
        """Return publisher, cycle counter and PDs of a frame; None if it is no process data.

        A PD is the number of its source, None if the plant has no such PD, and its data.
        """
        if len(data) < 2 or data[1] >> 4 != FrameType.PROCESS_DATA:
            return None
        try:
            header = PdFrameHeader.decode(data, PD_FRAME_START)
            pds = list(iter_pds(data))
        except CodecError:
            return None
        publisher = str(header.publisher)
        return (
            publisher,
            header.cycle,
            [
                (self._pds.get((publisher, pd.pd_id, pd.version, pd.length)), bytes(content))
                for pd, content in pds
            ],
        )

    def placed_of(self, source: int) -> list[PlacedVariable]:
        """Return the variables of a PD with their places in its data."""
        return self._placed[source][1].placed()

    def name_of(self, source: int) -> str:
        """Return the name of a PD with that of its station."""
        station, pd = self._placed[source]
        return f"{station}/{pd.name}"

    def messages_of(self, source: int) -> StationMessages:
        """Return the encoder and decoder of a source."""
        return self._messages[source]

    def _scan(self, capture: CaptureFile) -> None:
        try:
            for packet in capture.packets():
                self.messages += 1
                at_ns = packet.at_ns
                self.first_ns = at_ns if self.first_ns is None else min(self.first_ns, at_ns)
                self.last_ns = at_ns if self.last_ns is None else max(self.last_ns, at_ns)
                self.events += events_in(packet.comments)
        except MalformedError:
            # A recorder that was killed leaves a block cut off: what is before it is kept.
            if not capture.interfaces:
                raise
            self.is_finished = False
        if any(each.link_type != ETHERNET for each in capture.interfaces):
            raise MalformedError("no capture of Ethernet", layout=str(self.path))
        self.events += events_in(capture.last_comments)
        self.events.sort(key=lambda each: each.time_ns)
        self._lost = capture.lost

    def _add_pd(self, frame: RecordedFrame, pd: RecordedPd) -> None:
        number = len(self.sources)
        messages = StationMessages(frame.station, pd.placed())
        self._messages.append(messages)
        self._placed.append((frame.station, pd))
        self.sources[number] = source_of(messages)
        # With version and size: data of another layout would be read as wrong values.
        self._pds[frame.publisher, pd.pd_id, pd.version, pd.size] = number


def events_in(comments: Iterable[str]) -> Iterator[RecordingEvent]:
    """Yield the events among the comments of a packet."""
    for comment in comments:
        if comment.startswith(EVENT_COMMENT):
            with suppress(ValueError, RecursionError):  # of a later release
                yield msgspec.json.decode(comment[len(EVENT_COMMENT) :], type=RecordingEvent)


def _tolerant(capture: CaptureFile) -> Iterator[CapturePacket]:
    """Yield packets until the file ends, whole or not."""
    try:
        yield from capture.packets()
    except MalformedError:
        return


def _section(
    comments: Iterable[bytes], path: Path
) -> tuple[dict[str, str], list[AttachedFile], tuple[RecordedFrame, ...]]:
    facts: dict[str, str] = {}
    published = b""
    files: dict[str, bytes] = {}
    for comment in comments:
        begin, _, part = comment.partition(b"\n")
        head = begin.decode("utf-8", "replace")
        if head.startswith(HEADER_COMMENT):
            try:
                facts = msgspec.json.decode(head[len(HEADER_COMMENT) :], type=dict[str, str])
            except (ValueError, RecursionError) as exc:
                raise MalformedError(f"damaged comment: {exc}", layout=str(path)) from None
            check_format(facts, str(path))
        elif head.startswith(PUBLISHED_COMMENT):
            published += part
        elif head.startswith(FILE_COMMENT):
            name = head[len(FILE_COMMENT) :].rpartition(" ")[0]
            # A comment has at most 65,535 bytes: longer files come in parts.
            files[name] = files.get(name, b"") + part
    try:
        frames = decode_published(published) if published else ()
    except ValueError as exc:
        raise MalformedError(str(exc), layout=str(path)) from None
    return facts, [AttachedFile(*each) for each in files.items()], frames
