"""Addition of stations and types to the text of an existing plant file, with all else as it was.

Both are put behind those that are there, as lines.  Then both texts are read: unless they differ in
these parts only, the addition is refused.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, TypeAlias

from eap.config.document import Node, parse
from eap.config.finding import FindingReport

_KEY = re.compile(r"[^\s#-]")
"""Start of a line that begins a key of the top level."""
_STATIONS, _TYPES = "stations", "types"
_INDENT = 2
"""Spaces before what is added."""
_Tree: TypeAlias = dict[str, tuple[int, Node]]


class InsertionError(ValueError):
    """The stations cannot be added to this file."""


def insert_stations(text: str, stations: Sequence[str], types: Sequence[str] = ()) -> str:
    """Return *text*, a plant file, with stations and types added.

    Args:
        text: The file.
        stations: Lines of the stations, as items of a list that is indented by two spaces.
        types: Lines of the section of types; may be empty.

    Raises:
        InsertionError: the file is written in a way in which lines cannot be added to it, or has
            another type of the same name.
    """
    mark = "\ufeff" if text.startswith("\ufeff") else ""
    newline = "\r\n" if "\r\n" in text else "\n"
    before = _tree(text.removeprefix(mark))
    # A text that ends with a line end has an empty last line.
    lines = text.removeprefix(mark).split(newline)
    node = before[_STATIONS][1] if _STATIONS in before else None
    if node is None or not isinstance(node.value, list) or not node.value:
        raise InsertionError("it has no list of stations")
    first = re.match(r"( *)- ", lines[node.value[0].line - 1])
    if first is None:
        raise InsertionError("its list of stations is not written with a line for each station")
    lines = _append(lines, before[_STATIONS][0], ["", *_indented(stations, first[1])])
    if types:
        lines = _with_types(lines, _tree(newline.join(lines)), types)
    result = newline.join(lines)
    _check(before, _tree(result))
    return mark + result


def _with_types(lines: list[str], tree: _Tree, types: Sequence[str]) -> list[str]:
    if _TYPES not in tree:
        at = tree[_STATIONS][0] - 1
        return [*lines[:at], *types, "", *lines[at:]]
    start, node = tree[_TYPES]
    if not isinstance(node.value, dict) or not node.value:
        raise InsertionError("its types are not a mapping from names")
    first_line = next(iter(node.value.values()))[0]
    if first_line == start:
        raise InsertionError("its types are not written with a line for each type")
    own = {name: _plain(each) for name, (_, each) in node.value.items()}
    added = _tree("\n".join(types))[_TYPES][1].value
    missing: list[str] = []
    for name, (line, each) in added.items() if isinstance(added, dict) else ():
        if name not in own:
            missing += _entry(types, line)
        elif own[name] != _plain(each):
            raise InsertionError(f"it has another type {name}")
    margin = re.match(r" *", lines[first_line - 1])
    return (
        _append(lines, start, _indented(missing, margin[0] if margin else "")) if missing else lines
    )


def _entry(types: Sequence[str], line: int) -> Sequence[str]:
    """Return the lines of the entry that begins in *line*."""
    end = line
    while end < len(types) and types[end].startswith(" " * (_INDENT + 1)):
        end += 1
    return types[line - 1 : end]


def _indented(lines: Sequence[str], margin: str) -> list[str]:
    return [f"{margin}{line[_INDENT:]}" if line.strip() else "" for line in lines]


def _append(lines: list[str], start: int, added: Sequence[str]) -> list[str]:
    """Return *lines* with more at the end of the part whose key is in line *start*."""
    end = next((at for at in range(start, len(lines)) if _KEY.match(lines[at])), len(lines))
    # Comments at the margin belong to what follows.
    while end > start and (not lines[end - 1].strip() or lines[end - 1].startswith("#")):
        end -= 1
    tail = lines[end:] or [""]
    return [*lines[:end], *added, *tail]


def _tree(text: str) -> _Tree:
    report = FindingReport("")
    root = parse(text, report)
    if root is None or not isinstance(root.value, dict) or report.findings():
        raise InsertionError("it is not a plant file that can be read")
    return root.value


def _check(before: _Tree, after: _Tree) -> None:
    """Raise InsertionError unless *after* is *before* with more stations and types."""
    old = {name: _plain(node) for name, (_, node) in before.items()}
    new = {name: _plain(node) for name, (_, node) in after.items()}
    new[_STATIONS] = new[_STATIONS][: len(old[_STATIONS])]
    if _TYPES not in old:
        new.pop(_TYPES, None)
    elif isinstance(old[_TYPES], dict):
        new[_TYPES] = {name: each for name, each in new[_TYPES].items() if name in old[_TYPES]}
    if old != new:
        raise InsertionError("lines cannot be added to it without changing something else")


def _plain(node: Node) -> Any:
    value = node.value
    if isinstance(value, dict):
        return {name: _plain(each) for name, (_, each) in value.items()}
    return [_plain(each) for each in value] if isinstance(value, list) else value
