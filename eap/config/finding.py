"""What is wrong with a plant file, and where: collected, not raised, so that all is seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterable


class Finding(msgspec.Struct, frozen=True):
    """One thing to correct."""

    file: str
    line: int
    """From 1; 0 when the file as a whole is meant."""
    path: str
    """Such as ``stations[0].publish[1].id``; empty for the file as a whole."""
    message: str
    expected: str

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place}: {self.message}; expected {self.expected}"


class Report:
    """Collects findings and knows the line of every path of the file.

    *broken* holds the names of items that could not be read: whoever refers to one of them is not
    blamed for it.
    """

    def __init__(self, file: str) -> None:
        self.file = file
        self.lines: dict[str, int] = {}
        self.broken: set[str] = set()
        self._findings: dict[tuple[int, str, str], Finding] = {}
        self._adopted: list[Finding] = []

    def add(self, path: str, message: str, expected: str, *, line: int | None = None) -> None:
        """Report *message* at *path*; without *line* the one of the path or of what holds it."""
        where = self.line_of(path) if line is None else line
        # An anchor used at many places is wrong once.
        self._findings.setdefault(
            (where, message, expected), Finding(self.file, where, path, message, expected)
        )

    def adopt(self, findings: Iterable[Finding]) -> None:
        """Take over what is wrong with another file."""
        self._adopted += findings

    def has(self, path: str) -> bool:
        """Tell whether something is wrong at *path* itself."""
        return any(finding.path == path for finding in self._findings.values())

    def line_of(self, path: str) -> int:
        """Return the line of *path*, or of the nearest thing around it that the file has."""
        while path and path not in self.lines:
            path = path[: max(path.rfind("."), path.rfind("["), 0)]
        return self.lines.get(path, 0)

    def findings(self) -> tuple[Finding, ...]:
        """Return all findings in the order of the file, then those of other files."""
        own = sorted(self._findings.values(), key=lambda finding: finding.line)
        return (*own, *self._adopted)


def one_of(known: Iterable[str]) -> str:
    """Return *known* as the text of what was expected."""
    names = ", ".join(known)
    return f"one of {names}" if names else "none (there are none here)"
