"""Values of an MCAP file that this project wrote."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Iterator
from pathlib import Path

import msgspec

from eap.errors import MalformedError
from eap.recording.header import AttachedFile, EventKind, RecordingEvent, check_format
from eap.recording.mcap_file import McapChannel, McapFile
from eap.recording.messages import RecordedVariable, StationMessages, pack_closely
from eap.recording.published import RecordedFrame, decode_published
from eap.recording.rows import ALL, RawRow, TimeWindow, ValueRow, ValueSource, source_of
from eap.recording.values_writer import EVENTS, HEADER, PUBLISHED, STATION, VARIABLES

_REORDER_NS = 2_000_000_000
"""A recorder writes the stations one after another, each up to this late."""


class ValuesFile:
    """One recording of values.

    Attributes:
        facts: Plant, host and options of the recorder.
        sources: Stations with their variables.
        files: Files of the plant.
        published: PDs of the plant.
        events: Marks and losses, in order.
        messages: Number of messages of stations.
        first_ns: Time of the first message, None if there is none.
        last_ns: Time of the last message.
        is_finished: False if the recorder runs or was killed.

    Raises:
        OSError: the file cannot be read.
        MalformedError: it is no recording of this project.
    """

    def __init__(self, path: Path) -> None:
        self._content = content = McapFile(path)
        self._messages: dict[int, StationMessages] = {}
        self.sources: dict[int, ValueSource] = {}
        self.is_finished = content.is_finished
        self.facts = next((each.values for each in content.metadata if each.name == HEADER), {})
        if not self.facts:
            raise MalformedError(
                "an MCAP file, but no recording of eapctl", layout=str(path), offset=0
            )
        check_format(self.facts, str(path))
        self.files: list[AttachedFile] = []
        self.published: tuple[RecordedFrame, ...] = ()
        for each in content.attachments:
            if each.name == PUBLISHED:
                self.published = _published(each.data, path)
            else:
                self.files.append(AttachedFile(each.name, each.data))
        for number, channel in content.channels.items():
            if STATION in channel.metadata:
                self._add_source(number, channel, path)
        chunks = [chunk for chunk in content.chunks if chunk.counts.keys() & self.sources.keys()]
        self.first_ns = min((chunk.first_ns for chunk in chunks), default=None)
        self.last_ns = max((chunk.last_ns for chunk in chunks), default=None)
        self.messages = sum(
            count
            for chunk in chunks
            for number, count in chunk.counts.items()
            if number in self.sources
        )
        self.events = sorted(self._read_events(), key=lambda each: each.time_ns)

    @property
    def lost(self) -> int:
        """Cycles that the recorder did not get."""
        return sum(each.count for each in self.events if each.kind is EventKind.LOST)

    @property
    def damaged_chunks(self) -> int:
        """Chunks whose messages could not be read so far."""
        return len(self._content.damaged_chunks)

    def rows(
        self, window: TimeWindow = ALL, sources: Collection[int] | None = None
    ) -> Iterator[ValueRow]:
        """Yield the values of *sources* (all of them) in a time window, the oldest first."""
        for at_ns, source, _, data in self.raw_rows(window, sources):
            yield ValueRow(at_ns, source, *self._messages[source].unpack(data))

    def raw_rows(
        self, window: TimeWindow = ALL, sources: Collection[int] | None = None
    ) -> Iterator[RawRow]:
        """Yield the messages of *sources*; their cycles have 32 bits."""
        wanted = self._messages.keys() if sources is None else self._messages.keys() & set(sources)
        low = window.from_ns or 0
        high = (1 << 64) if window.until_ns is None else window.until_ns
        waiting: list[RawRow] = []
        newest = 0
        for chunk in self._content.chunks:
            # The index tells it: a chunk that is not wanted is not even decompressed.
            if chunk.last_ns < low or chunk.first_ns > high or not chunk.counts.keys() & wanted:
                continue
            for channel, sequence, time_ns, data, _ in self._content.messages(chunk):
                if channel in wanted and low <= time_ns <= high:
                    waiting.append(RawRow(time_ns, channel, sequence, data))
            newest = max(newest, chunk.last_ns)
            waiting.sort(key=_by_time)
            ready = bisect_left(waiting, newest - _REORDER_NS, key=_by_time)
            yield from waiting[:ready]
            del waiting[:ready]
        yield from waiting

    def messages_of(self, source: int) -> StationMessages:
        """Return the encoder and decoder of a source."""
        return self._messages[source]

    def _add_source(self, number: int, channel: McapChannel, path: Path) -> None:
        try:
            variables = msgspec.json.decode(
                channel.metadata[VARIABLES], type=list[RecordedVariable]
            )
            messages = StationMessages(channel.metadata[STATION], pack_closely(variables))
        except (KeyError, ValueError, RecursionError) as exc:
            raise MalformedError(
                f"channel {channel.topic} has damaged variables: {exc}", layout=str(path)
            ) from None
        schema = self._content.schemas.get(channel.schema)
        if schema is None or schema.data != messages.descriptor():
            raise MalformedError(
                f"channel {channel.topic} has another schema than its variables: use the release"
                " of eap-appliance that recorded it",
                layout=str(path),
            )
        self._messages[number] = messages
        self.sources[number] = source_of(messages)

    def _read_events(self) -> Iterator[RecordingEvent]:
        channels = [n for n, each in self._content.channels.items() if each.topic == EVENTS]
        for chunk in self._content.chunks:
            if not any(chunk.counts.get(channel) for channel in channels):
                continue
            for message in self._content.messages(chunk):
                if message.channel in channels:
                    try:
                        yield msgspec.json.decode(message.data, type=RecordingEvent)
                    except (ValueError, RecursionError):
                        continue  # of a later release


def _by_time(row: RawRow) -> int:
    return row.time_ns


def _published(octets: bytes, path: Path) -> tuple[RecordedFrame, ...]:
    try:
        return decode_published(octets)
    except ValueError as exc:
        raise MalformedError(str(exc), layout=str(path)) from None
