"""Recordings of either kind: opened by their first bytes, and described."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from msgspec import Struct

from eap.codec.datatypes import parse
from eap.errors import MalformedError
from eap.recording.capture_file import is_capture
from eap.recording.frames_reader import FramesFile
from eap.recording.published import RecordedFrame
from eap.recording.repair import is_being_written

if TYPE_CHECKING:
    # mcap is an extra, and recordings of frames are read without it.
    from eap.recording.values_reader import ValuesFile

    Recording: TypeAlias = FramesFile | ValuesFile

_NS = 1_000_000_000


class VariableInfo(Struct, frozen=True):
    """Type and unit of a recorded variable."""

    type: str
    unit: str


class EventInfo(Struct, kw_only=True):
    """A mark, a loss or a trigger; *time* is ISO 8601 in UTC."""

    time: str
    kind: str
    station: str
    text: str
    count: int


class RecordingInfo(Struct, kw_only=True, rename={"from_": "from"}):
    """``eapctl record info``: times are ISO 8601 in UTC, *seconds* the time between them.

    *messages* counts messages of stations, or frames.  *finished* is False for a file whose
    recorder runs (then *recording* is True) or was killed.
    """

    file: str
    kind: Literal["values", "frames"]
    from_: str | None
    until: str | None
    seconds: float
    messages: int
    lost: int
    bytes: int
    finished: bool
    recording: bool
    damaged_chunks: int
    plant: str
    facts: dict[str, str]
    files: list[str]
    interfaces: list[str]
    variables: list[str]
    types: dict[str, VariableInfo]
    events: list[EventInfo]


def open_recording(path: Path, published: Iterable[RecordedFrame] = ()) -> Recording:
    """Return the recording in *path*; *published* are the PDs for a capture that names none.

    Raises:
        OSError: the file cannot be read.
        MalformedError: it is no recording.
        EnvironmentalError: it needs an extra that is not installed.
    """
    if is_capture(path):
        return FramesFile(path, published)
    with path.open("rb") as file:
        magic = file.read(5)
    if magic != b"\x89MCAP":
        raise MalformedError(
            "neither a recording of values (MCAP) nor of frames (pcapng, pcap)", layout=str(path)
        )
    from eap.recording.values_reader import ValuesFile

    return ValuesFile(path)


def describe(path: Path) -> RecordingInfo:
    """Return facts on the recording in *path*; raise as :func:`open_recording` does."""
    recording = open_recording(path)
    first, last = recording.first_ns, recording.last_ns
    seconds = 0.0 if first is None or last is None else (last - first) / _NS
    types = {}
    for source in recording.sources.values():
        for column in source.columns:
            types[column.variable] = VariableInfo(parse(column.type).name, column.unit)
    is_frames = isinstance(recording, FramesFile)
    facts = dict(recording.facts)
    return RecordingInfo(
        file=str(path),
        kind="frames" if is_frames else "values",
        from_=None if first is None else iso_time(first),
        until=None if last is None else iso_time(last),
        seconds=seconds,
        messages=recording.messages,
        lost=recording.lost,
        bytes=path.stat().st_size,
        finished=recording.is_finished,
        recording=is_being_written(path),
        damaged_chunks=recording.damaged_chunks,
        plant=facts.pop("plant", ""),
        facts=facts,
        files=[each.name for each in recording.files],
        interfaces=recording.interfaces if isinstance(recording, FramesFile) else [],
        variables=list(types),
        types=types,
        events=[
            EventInfo(
                time=iso_time(each.time_ns),
                kind=each.kind,
                station=each.station,
                text=each.text,
                count=each.count,
            )
            for each in recording.events
        ],
    )


_LAST_YEAR_END_S = 253_402_300_800


def iso_time(at_ns: int) -> str:
    """Return Unix time as ISO 8601 in UTC with nanoseconds; as a number behind the year 9999."""
    if at_ns >= _LAST_YEAR_END_S * _NS:
        return f"{at_ns} ns"  # of a file that is damaged: datetime has no such year
    at = datetime.fromtimestamp(at_ns // _NS, UTC)
    return f"{at:%Y-%m-%dT%H:%M:%S}.{at_ns % _NS:09}Z"
