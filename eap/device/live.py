"""The seam to the running engine: where a dictionary gets what changes by itself."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Protocol


class LiveValues(Protocol):
    """The process image of a station, or nothing while there is none."""

    def octets(self, key: str, name: str) -> bytes | None:
        """Return what *key* (of the profile's live entries) shows of the object called *name*.

        None, or octets of another length than the entry has, reads as zero: the object is not yet,
        or no longer, part of what runs.
        """

    def at_one_moment(self) -> AbstractContextManager[None]:
        """Show counters of one moment for the length of a block."""


class NothingRuns:
    """The live values of a device whose engine does not run."""

    def octets(self, key: str, name: str) -> bytes | None:
        """Return None for everything."""
        return None

    def at_one_moment(self) -> AbstractContextManager[None]:
        """Do nothing."""
        return nullcontext()
