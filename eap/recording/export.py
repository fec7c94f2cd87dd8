"""Recordings in other forms: CSV, MCAP and pcapng; Parquet is in :mod:`eap.recording.parquet`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from eap.codec.basetypes import Boolean, DataType
from eap.codec.enumerations import Enumeration
from eap.codec.times import Timed
from eap.errors import ConfigError
from eap.recording.capture_file import LATEST_NS
from eap.recording.frames_reader import FramesFile, events_in
from eap.recording.frames_writer import EVENT_COMMENT, FramesWriter
from eap.recording.header import RecordingHeader
from eap.recording.messages import PlacedVariable, StationMessages, pack_closely
from eap.recording.rows import TimeWindow, ValueColumn, ValueRow, plain_value, select

if TYPE_CHECKING:
    from eap.recording.recording_file import Recording
    from eap.recording.values_writer import ValuesWriter

Selection = Mapping[int, Mapping[int, ValueColumn]]
"""Columns by source, and by their positions in its rows."""
TIME = "time_ns"
"""Name of the first column."""


class ExportCount(NamedTuple):
    """Rows and columns that were written; of frames the packets, and 0."""

    rows: int
    columns: int


def column_names(selection: Selection) -> list[str]:
    """Return the names of all columns without the time, each once, in order."""
    names = {each.name: None for chosen in selection.values() for each in chosen.values()}
    return list(names)


def merged_rows(rows: Iterator[ValueRow]) -> Iterator[tuple[int, list[ValueRow]]]:
    """Yield the rows of each time together; of one source only one is in a group."""
    group: dict[int, ValueRow] = {}
    at_ns = -1
    for row in rows:
        # Two rows of one source with the same time are two lines.
        if row.time_ns != at_ns or row.source in group:
            if group:
                yield at_ns, list(group.values())
            group, at_ns = {}, row.time_ns
        group[row.source] = row
    if group:
        yield at_ns, list(group.values())


def write_csv(
    recording: Recording, window: TimeWindow, selection: Selection, write: Callable[[str], object]
) -> ExportCount:
    """Write a header and a line for each time; cells without a value then are empty.

    Numbers are written so that they read as the same bits again, truth values as 0 and 1, bytes as
    hexadecimal digits, enumerations by name, times and dates as texts.
    """
    names = column_names(selection)
    places = {name: place for place, name in enumerate(names, start=1)}
    plans = {
        source: [
            (position, places[column.name], _csv_text(column.kind))
            for position, column in chosen.items()
        ]
        for source, chosen in selection.items()
    }
    write(",".join((TIME, *map(_quoted, names))) + "\n")
    blank = [""] * (len(names) + 1)
    count = 0
    for at_ns, rows in merged_rows(recording.rows(window, plans.keys())):
        # A station without a sample of that time leaves its cells empty.
        cells = blank.copy()
        cells[0] = str(at_ns)
        for row in rows:
            values = row.values
            for position, place, to_text in plans[row.source]:
                cells[place] = to_text(values[position])
        write(",".join(cells) + "\n")
        count += 1
    return ExportCount(count, len(names))


def _csv_text(kind: DataType) -> Callable[[Any], str]:
    if isinstance(kind, Boolean):
        return lambda value: "1" if value else "0"
    if isinstance(kind, Enumeration | Timed):
        return lambda value: _quoted(str(plain_value(kind, value)))
    return _plain_text


def _plain_text(value: Any) -> str:
    if isinstance(value, str):
        return _quoted(value)
    return value.hex() if isinstance(value, bytes) else repr(value)


def _quoted(text: str) -> str:
    if any(sign in text for sign in ',"\r\n'):
        doubled = text.replace('"', '""')
        return f'"{doubled}"'
    return text


def write_mcap(
    recording: Recording, window: TimeWindow, selection: Selection, path: Path
) -> ExportCount:
    """Write a new recording of values; raise FileExistsError if *path* is there."""
    from eap.recording.values_writer import ValuesWriter

    writer = ValuesWriter(path, header_of(recording))
    try:
        channels = {
            source: _add_channel(writer, recording, source, chosen)
            for source, chosen in selection.items()
        }
        for event in recording.events:
            if event.time_ns in window:
                writer.add_event(event)
        for at_ns, source, cycle, data in recording.raw_rows(window, selection.keys()):
            channel, sample_of = channels[source]
            writer.write(channel, *sample_of(cycle, data, at_ns))
        return ExportCount(writer.messages, len(column_names(selection)))
    finally:
        writer.close()


_Sample = tuple[int, int, bytes]
"""Cycle, time and sample."""


def _add_channel(
    writer: ValuesWriter, recording: Recording, source: int, chosen: Mapping[int, ValueColumn]
) -> tuple[int, Callable[[int, bytes, int], _Sample]]:
    messages = recording.messages_of(source)
    wanted = {column.variable for column in chosen.values()}
    if isinstance(recording, FramesFile):
        placed = recording.placed_of(source)
        topic = recording.name_of(source)
    else:
        placed = pack_closely(messages.variables)
        topic = ""
    kept = [each for each in placed if f"{messages.station}/{each.variable.name}" in wanted]
    channel = writer.add_station(messages.station, kept, topic)
    if isinstance(recording, FramesFile):
        return channel, lambda cycle, data, at_ns: (cycle, at_ns, data)
    return channel, _unpacked(messages, placed)


def _unpacked(
    messages: StationMessages, placed: Sequence[PlacedVariable]
) -> Callable[[int, bytes, int], _Sample]:
    from eap.codec.datatypes import parse

    size = sum(parse(each.variable.type).size for each in placed)

    def sample_of(_: int, data: bytes, at_ns: int) -> _Sample:
        cycle, values = messages.unpack(data)
        return cycle, at_ns, messages.sample(values, size)

    return sample_of


def write_pcapng(
    recording: Recording, window: TimeWindow, patterns: Sequence[str], path: Path
) -> ExportCount:
    """Write a new recording of frames; *patterns* keep those with a PD that has such a variable.

    Raises:
        ConfigError: *recording* has no frames, or a pattern names nothing.
        FileExistsError: *path* is there.
    """
    recording = require_frames(recording)
    wanted = set(select(recording.sources, patterns)) if patterns else None
    writer = FramesWriter(path, header_of(recording))
    pending = [event for event in recording.events if event.time_ns in window]
    try:
        interfaces = {}
        for captured, _, data in recording.frames():
            if captured.at_ns not in window:
                continue
            if wanted is not None:
                frame = recording.pds_of(data)
                if frame is None or not any(source in wanted for source, _ in frame[2]):
                    continue
            if captured.interface not in interfaces:
                described = recording.described[captured.interface]
                number = writer.add_interface(described.name, described.description)
                interfaces[captured.interface] = number
            comments = [each for each in captured.comments if not each.startswith(EVENT_COMMENT)]
            for event in events_in(captured.comments):
                if event in pending:
                    pending.remove(event)
                    writer.add_event(event, interfaces[captured.interface])
            writer.write(
                interfaces[captured.interface],
                captured.at_ns,
                captured.octets,
                outbound=captured.outbound,
                comment="\n".join(comments),
            )
        for event in pending:
            writer.add_event(event)
        return ExportCount(writer.frames, 0)
    finally:
        writer.close(recording.last_ns or 0)


def require_frames(recording: Recording) -> FramesFile:
    """Return *recording* if it has frames; raise ConfigError if it has values."""
    if isinstance(recording, FramesFile):
        return recording
    raise ConfigError(
        "a recording of values has no frames: export it with --csv, --parquet or --mcap, and"
        " record frames with record start --frames"
    )


def header_of(recording: Recording) -> RecordingHeader:
    """Return the origin of *recording*, for a file that is made of it."""
    facts = dict(recording.facts)
    own = {"format", "release", "plant", "host", "started_ns"}
    started = facts.get("started_ns", "")
    return RecordingHeader(
        plant=facts.get("plant", ""),
        host=facts.get("host", ""),
        started_ns=min(int(started[:20]), LATEST_NS) if started.isdecimal() else 0,
        options={name: text for name, text in facts.items() if name not in own},
        files=tuple(recording.files),
        published=recording.published,
    )
