"""Section of the key ``record`` of a plant file: recordings that run beside the plant.

The recorder gets it as it is, with a resolved folder; docs/recordings.md explains it.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, TypeAlias

from msgspec import Meta

from eap.config.structs import Section

TimeText: TypeAlias = str | int
"""Such as ``20s``; a number is in seconds."""


class RecordKind(StrEnum):
    """Content of a recording."""

    VALUES = "values"
    FRAMES = "frames"


class RecordSection(Section, frozen=True, kw_only=True):
    """One recording; its keys are the options of ``eapctl record start``."""

    name: str
    folder: str = ""
    of: str | tuple[str, ...] = ()
    kind: RecordKind = RecordKind.VALUES
    every: str | int = 1
    ring: TimeText = ""
    when: str = ""
    before: TimeText = ""
    after: TimeText = ""
    split: str = ""
    keep: Annotated[int, Meta(ge=1, le=100_000)] | None = None
    to: str = ""

    @property
    def patterns(self) -> tuple[str, ...]:
        """The patterns of *of*."""
        return (self.of,) if isinstance(self.of, str) else self.of
