"""Facts that every recording begins with, and the records of its events."""

from __future__ import annotations

from enum import StrEnum

from msgspec import Struct

from eap.recording.published import RecordedFrame

FORMAT = "1"
"""Version of what this project writes into MCAP and pcapng files beside values and frames."""


class AttachedFile(Struct, frozen=True):
    """A file of the plant, with the name that the plant knows it by."""

    name: str
    content: bytes


class RecordingHeader(Struct, frozen=True, kw_only=True):
    """Origin of a recording.

    *started_ns* is Unix time; *options* are those of the command, for people.
    """

    plant: str
    host: str
    started_ns: int
    options: dict[str, str] = {}
    files: tuple[AttachedFile, ...] = ()
    published: tuple[RecordedFrame, ...] = ()


class EventKind(StrEnum):
    """Kinds of events in a recording."""

    MARK = "mark"
    """A text of the user."""
    LOST = "lost"
    """Cycles or frames that the recorder did not get."""
    TRIGGER = "trigger"
    """The condition of a ring recording became true."""


class RecordingEvent(Struct, frozen=True, kw_only=True):
    """Something that happened while recording; *count* is the number of lost cycles or frames."""

    time_ns: int
    kind: EventKind
    text: str = ""
    station: str = ""
    count: int = 0
