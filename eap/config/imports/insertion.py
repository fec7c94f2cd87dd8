"""Addition of stations to the text of an existing plant file, with all else as it was.

The stations are put behind the last one, as lines.  Then both texts are read: unless they differ in
these stations only, the addition is refused.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from eap.config.document import Node, parse
from eap.config.finding import FindingReport

_KEY = re.compile(r"[^\s#-]")
"""Start of a line that begins a key of the top level."""


class InsertionError(ValueError):
    """The stations cannot be added to this file."""


def insert_stations(text: str, stations: Sequence[str], types: Sequence[str] = ()) -> str:
    """Return *text*, a plant file, with stations and types added.

    Args:
        text: The file.
        stations: Lines of the stations, as items of a list that is indented by two spaces.
        types: Lines of the section of types; may be empty.

    Raises:
        InsertionError: the file is written in a way in which lines cannot be added to it.
    """
    mark = "\ufeff" if text.startswith("\ufeff") else ""
    text = text.removeprefix(mark)
    before = _tree(text)
    key = before.get("stations")
    if key is None or not isinstance(key[1].value, list) or not key[1].value:
        raise InsertionError("it has no list of stations")
    newline = "\r\n" if "\r\n" in text else "\n"
    lines = text.split(newline)
    # A text that ends with a line end has an empty last line.
    start = key[0]
    first = re.match(r"( *)- ", lines[key[1].value[0].line - 1])
    if first is None:
        raise InsertionError("its list of stations is not written with a line for each station")
    end = next((at for at in range(start, len(lines)) if _KEY.match(lines[at])), len(lines))
    # Comments at the margin belong to what follows.
    while end > start and (not lines[end - 1].strip() or lines[end - 1].startswith("#")):
        end -= 1
    added = [f"{first[1]}{line[2:]}" if line.strip() else "" for line in stations]
    merged = [*lines[:end], "", *added, *lines[end:]]
    if end == len(lines):
        merged.append("")
    if types:
        if "types" in before:
            raise InsertionError("it has types of its own")
        merged[start - 1 : start - 1] = [*types, ""]
    result = newline.join(merged)
    _check(before, _tree(result), has_types=bool(types))
    return mark + result


def _tree(text: str) -> dict[str, tuple[int, Node]]:
    report = FindingReport("")
    root = parse(text, report)
    if root is None or not isinstance(root.value, dict) or report.findings():
        raise InsertionError("it is not a plant file that can be read")
    return root.value


def _check(
    before: dict[str, tuple[int, Node]], after: dict[str, tuple[int, Node]], *, has_types: bool
) -> None:
    """Raise InsertionError unless *after* is *before* with more stations."""
    old = {name: _plain(node) for name, (_, node) in before.items()}
    new = {name: _plain(node) for name, (_, node) in after.items()}
    if has_types:
        new.pop("types", None)
    new["stations"] = new["stations"][: len(old["stations"])]
    if old != new:
        raise InsertionError("lines cannot be added to it without changing something else")


def _plain(node: Node) -> Any:
    value = node.value
    if isinstance(value, dict):
        return {name: _plain(each) for name, (_, each) in value.items()}
    return [_plain(each) for each in value] if isinstance(value, list) else value
