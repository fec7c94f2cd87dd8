"""Findings in a plant file with their lines: collected, not raised, so that users see all."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterable

    from eap.config.document import Node
    from eap.pd.rules import RuleViolation

_VARYING = re.compile(r"'[^']*'|\S*\d\S*|, did you mean [^?]*\?")
"""Parts of a message that differ from one use of an anchor to the next."""


class PlantFinding(msgspec.Struct, frozen=True):
    """One error in a plant file, or a warning about it."""

    file: str
    line: int
    """From 1; 0 for the file as a whole."""
    path: str
    """Such as ``stations[0].publish[1].id``; empty for the file as a whole."""
    message: str
    expected: str

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place}: {self.message}; expected {self.expected}"


class FindingReport:
    """Collects findings and knows the line of every path of the file.

    *broken* holds the names of items that could not be read: a reference to one of them is no
    finding of its own.  *stations* are the names of the stations, as far as they are known.

    A part of the file that an anchor repeats has one finding, at its first use, with the number of
    further uses.

    Attributes:
        warnings: Warnings about the file, and about other files, without repetition.
    """

    def __init__(self, file: str) -> None:
        self.file = file
        self.lines: dict[str, int] = {}
        self.broken: set[str] = set()
        self.stations: set[str] = set()
        self.broken_types: set[str] = set()
        """Texts of types that have a finding, or whose definition has one."""
        self.warnings: list[PlantFinding] = []
        self._nodes: dict[str, Node] = {}
        self._findings: dict[tuple[int, str, str], PlantFinding] = {}
        self._first_use: dict[tuple[int, str, str], PlantFinding] = {}
        self._further_uses: dict[PlantFinding, set[str]] = {}
        self._adopted: list[PlantFinding] = []

    def enter(self, path: str, line: int, node: Node) -> None:
        """Remember that *path* leads to *node*, in *line*."""
        self.lines[path] = line
        self._nodes[path] = node

    def add(self, path: str, message: str, expected: str, *, line: int | None = None) -> None:
        """Report *message* at *path*; *line* defaults to that of the path or of its parent."""
        where = self.line_of(path) if line is None else line
        finding = PlantFinding(self.file, where, path, message, expected)
        first = self._first_use.setdefault(self._cause(path, message), finding)
        if first.path != path:
            self._further_uses.setdefault(first, set()).add(path)
        else:
            # Two checks may find the same: one line for the user.
            self._findings.setdefault((where, message, expected), finding)

    def warn(self, path: str, message: str, expected: str) -> None:
        """Record a warning about *path*."""
        warning = PlantFinding(self.file, self.line_of(path), path, message, expected)
        if warning not in self.warnings:
            self.warnings.append(warning)

    def add_error(self, path: str, subject: str, error: ValueError, expected: str) -> None:
        """Report an error of a data type or value; *expected* is for one that does not say it."""
        what, _, own = str(error).partition(": expected ")
        self.add(path, f"{subject}: {what}", own or expected)

    def add_breaches(self, at: str, breaches: Iterable[RuleViolation]) -> None:
        """Report *breaches* of rules by the section at *at*."""
        for breach in breaches:
            self.add(f"{at}.{breach.key}", breach.message, breach.expected)

    def adopt(self, findings: Iterable[PlantFinding]) -> None:
        """Add the findings of another file."""
        self._adopted += findings

    def has(self, path: str) -> bool:
        """Return whether *path* itself has a finding."""
        return any(finding.path == path for finding in self._findings.values()) or any(
            path in paths for paths in self._further_uses.values()
        )

    def line_of(self, path: str) -> int:
        """Return the line of *path*, or of its nearest parent that the file has."""
        while path and path not in self.lines:
            path = _parent(path)
        return self.lines.get(path, 0)

    def _cause(self, path: str, message: str) -> tuple[int, str, str]:
        """Return the key that findings of one part of the file share in all its uses."""
        known = path
        while known and known not in self._nodes:
            known = _parent(known)
        if not known:
            return 0, path, message
        # The uses of an anchor differ in the names of their stations only; those must not count.
        words = (word for word in message.split() if word.strip(":,") not in self.stations)
        shape = _VARYING.sub("", " ".join(words))
        # Uses of an anchor share a node, so its identity tells them from equal text without one.
        return id(self._nodes[known]), path.removeprefix(known), shape

    def findings(self) -> tuple[PlantFinding, ...]:
        """Return all findings in the order of the file, then those of other files."""
        own = sorted(map(self._with_uses, self._findings.values()), key=lambda each: each.line)
        return (*own, *self._adopted)

    def _with_uses(self, finding: PlantFinding) -> PlantFinding:
        further = len(self._further_uses.get(finding, ()))
        if not further:
            return finding
        places = "place" if further == 1 else "places"
        message = f"{finding.message} (and in {further} more {places}, by an anchor)"
        return msgspec.structs.replace(finding, message=message)


def _parent(path: str) -> str:
    return path[: max(path.rfind("."), path.rfind("["), 0)]


_SHOWN = 12
"""Names that are listed, where only those beside the unknown one help."""


def one_of(known: Iterable[str]) -> str:
    """Return *known* as the expectation of a finding."""
    names = ", ".join(known)
    return f"one of {names}" if names else "none (there are none here)"


def one_beside(name: str, known: Iterable[str]) -> str:
    """Return the expectation of one of *known*, of many those that begin as *name* does.

    A bus has hundreds of variables: of ``bus0.axis.csp.Target`` those of ``bus0.axis.csp`` are
    listed, else those of ``bus0.axis``, and so on.
    """
    names = list(known)
    prefix = name
    while len(names) > _SHOWN and "." in prefix:
        prefix = prefix.rpartition(".")[0]
        if beside := [each for each in names if each.startswith(f"{prefix}.")]:
            names = beside
            break
    more = len(names) - _SHOWN
    return one_of(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")
