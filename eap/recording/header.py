"""Facts that every recording begins with, and the records of its events."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from msgspec import Struct

from eap.errors import MalformedError
from eap.recording.published import RecordedFrame
from eap.release import RELEASE

FORMAT = "1"
"""Version of what this project writes into MCAP and pcapng files beside values and frames."""


def check_format(facts: Mapping[str, str], name: str) -> None:
    """Check that a recording is of the format that this release reads.

    Args:
        facts: Of its header; empty for a file of another program.
        name: Of the file, for the message.

    Raises:
        MalformedError: it is of another one.
    """
    found = facts.get("format", FORMAT)
    if found != FORMAT:
        release = facts.get("release", "another one")
        raise MalformedError(
            f"recording of format {found}, and release {RELEASE} reads format {FORMAT}: use the"
            f" release that recorded it ({release})",
            layout=name,
        )


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
    """Event while recording; *count* is the number of lost cycles or frames."""

    time_ns: int
    kind: EventKind
    text: str = ""
    station: str = ""
    count: int = 0
