"""YAML as a tree whose every node knows its line.

Built from the parser's events without recursion, because the usual composer follows hostile nesting
down the C stack.  Scalars follow YAML 1.2 (``on`` and ``10:20`` are texts), merge keys (``<<``) and
anchors work, duplicate keys are findings, and what aliases may blow a file up to is bounded.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, TypeAlias

import yaml

if TYPE_CHECKING:
    from pathlib import Path

    from eap.config.finding import FindingReport

MAX_FILE = 4 << 20
"""Octets of the largest plant file."""
MAX_DEPTH = 32
MAX_NODES = 200_000
"""Nodes of the largest plant, every use of an alias counted."""

_NODES = f"at most {MAX_NODES} values"

Scalar: TypeAlias = bool | int | float | str | None


class Node:
    """A scalar, a list of nodes, or a mapping from key to (line of the key, node)."""

    __slots__ = ("line", "value", "weight")

    def __init__(
        self, line: int, value: Scalar | list[Node] | dict[str, tuple[int, Node]], weight: int = 1
    ) -> None:
        self.line = line
        self.value = value
        self.weight = weight


class ScalarNode(Node):
    """A scalar, with its text as written; *plain* is false for quoted text."""

    __slots__ = ("plain", "text")

    def __init__(self, line: int, value: Scalar, text: str, *, plain: bool) -> None:
        super().__init__(line, value)
        self.text = text
        self.plain = plain


class _UnreadableError(Exception):
    def __init__(self, line: int, message: str, expected: str) -> None:
        super().__init__(message)
        self.line = line
        self.expected = expected


def read(path: Path, report: FindingReport) -> Node | None:
    """Return the tree of the file at *path*; None, with findings, if it has none."""
    text = ""
    try:
        text = _text(path)
        return _Builder(report).build(text)
    except _UnreadableError as exc:
        report.add("", str(exc), exc.expected, line=exc.line)
    except yaml.MarkedYAMLError as exc:
        mark = exc.problem_mark or exc.context_mark
        line = mark.line + 1 if mark else 0
        what = " ".join(part for part in (exc.context, exc.problem) if part)
        if tab := _tab_in(text, line):
            report.add("", f"line {line} {tab}", "spaces: YAML takes no tabs there", line=line)
        else:
            report.add("", f"not YAML: {what}", "valid YAML", line=line)
    except yaml.YAMLError as exc:
        report.add("", f"not YAML: {str(exc).splitlines()[0]}", "valid YAML", line=0)
    return None


def _text(path: Path) -> str:
    try:
        if path.is_dir():
            raise _UnreadableError(0, "is a directory", "a YAML file")
        if not path.exists():
            raise _UnreadableError(0, "does not exist", "a YAML file")
        if not path.is_file():
            raise _UnreadableError(0, "is not a regular file", "a YAML file")
        with path.open("rb") as file:
            octets = file.read(MAX_FILE + 1)
    except (OSError, ValueError) as exc:  # ValueError: a NUL in the path
        reason = exc.strerror if isinstance(exc, OSError) else None
        raise _UnreadableError(0, f"cannot be read: {reason or exc}", "a readable file") from None
    if len(octets) > MAX_FILE:
        raise _UnreadableError(0, "is too large", f"at most {MAX_FILE >> 20} MiB")
    try:
        return octets.decode("utf-8-sig")
    except UnicodeDecodeError as exc:
        line = octets.count(b"\n", 0, exc.start) + 1
        raise _UnreadableError(
            line, f"octet {octets[exc.start]:#04x} is no UTF-8", "UTF-8"
        ) from None


def _tab_in(text: str, line: int) -> str:
    """Return where *line* has a tab that YAML does not take; empty without one."""
    lines = text.split("\n")
    written = lines[line - 1] if 0 < line <= len(lines) else ""
    if _TAB_INDENT.match(written):
        return "begins with a tab"
    return "has a tab behind '-', '?' or ':'" if _TAB_BEHIND_SIGN.search(written) else ""


class _Open:
    """A list or mapping whose end has not been seen."""

    __slots__ = ("anchor", "items", "line", "mapping")

    def __init__(self, line: int, anchor: str | None, *, mapping: bool) -> None:
        self.line = line
        self.anchor = anchor
        self.mapping = mapping
        self.items: list[Node] = []


class _Builder:
    def __init__(self, report: FindingReport) -> None:
        self._report = report
        self._anchors: dict[str | None, Node] = {}
        self._stack: list[_Open] = []
        self._root: Node | None = None

    def build(self, text: str) -> Node:
        for event in yaml.parse(text, Loader=yaml.CSafeLoader):
            self._take(event)
        if self._root is None:
            raise _UnreadableError(1, "the file is empty", "a plant file (docs/plant-file.md)")
        return self._root

    def _take(self, event: yaml.Event) -> None:
        line = event.start_mark.line + 1 if event.start_mark else 0
        match event:
            case yaml.DocumentStartEvent() if self._root is not None:
                raise _UnreadableError(
                    line, "a second YAML document begins", "one document in a file"
                )
            case yaml.AliasEvent(anchor=anchor):
                if (node := self._anchors.get(anchor)) is None:
                    raise _UnreadableError(
                        line, f"no anchor &{anchor} ends before this", "a known anchor"
                    )
                self._place(node, None)
            case yaml.ScalarEvent():
                self._place(_scalar(event, line), event.anchor)
            case yaml.CollectionStartEvent():
                if len(self._stack) >= MAX_DEPTH:
                    raise _UnreadableError(line, "nested too deeply", f"at most {MAX_DEPTH} levels")
                mapping = isinstance(event, yaml.MappingStartEvent)
                self._stack.append(_Open(line, event.anchor, mapping=mapping))
            case yaml.CollectionEndEvent():
                done = self._stack.pop()
                self._place(self._close(done), done.anchor)

    def _place(self, node: Node, anchor: str | None) -> None:
        if anchor is not None:
            self._anchors[anchor] = node
        if self._stack:
            self._stack[-1].items.append(node)
        else:
            self._root = node

    def _close(self, done: _Open) -> Node:
        value: list[Node] | dict[str, tuple[int, Node]]
        if done.mapping:
            value = self._mapping(done.items)
            weight = 1 + sum(node.weight for _, node in value.values())
        else:
            value = done.items
            weight = 1 + sum(node.weight for node in value)
        if weight > MAX_NODES:
            raise _UnreadableError(done.line, "aliases make the plant too large", _NODES)
        return Node(done.line, value, weight)

    def _mapping(self, items: list[Node]) -> dict[str, tuple[int, Node]]:
        own: dict[str, tuple[int, Node]] = {}
        merged: dict[str, tuple[int, Node]] = {}
        for key, node in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, ScalarNode):
                self._report.add("", "a key is a list or mapping", "a text", line=key.line)
            elif key.plain and key.text == "<<":
                self._merge(merged, node, key.line)
            elif key.text in own:
                message = f"key {key.text!r} is given twice (first in line {own[key.text][0]})"
                self._report.add("", message, "each key once", line=key.line)
            else:
                own[key.text] = (key.line, node)
        # Merged keys first keeps the order in which a reader meets them.
        return {**merged, **own}

    def _merge(self, merged: dict[str, tuple[int, Node]], node: Node, line: int) -> None:
        for source in node.value if isinstance(node.value, list) else [node]:
            if not isinstance(source.value, dict):
                self._report.add("", "<< merges something else", "a mapping", line=line)
                return
            for key, entry in source.value.items():
                merged.setdefault(key, entry)


_TAB_INDENT = re.compile(r" *\t")
_TAB_BEHIND_SIGN = re.compile(r"(^|\s)[-?:] *\t|: *\t")
_NULL = {"", "~", "null", "Null", "NULL"}
_BOOL = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_INT = re.compile(r"[-+]?\d{1,100}|0x[0-9a-fA-F]{1,100}|0o[0-7]{1,100}", re.ASCII)
_FLOAT = re.compile(
    r"[-+]?(\.\d+|\d+(\.\d*)?)([eE][-+]?\d+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", re.ASCII
)


def _scalar(event: yaml.ScalarEvent, line: int) -> Node:
    if event.tag not in (None, "!", "tag:yaml.org,2002:str"):
        raise _UnreadableError(line, f"tag {event.tag!r} is not supported", "a value without a tag")
    plain = event.tag is None and event.implicit[0]
    value = _resolve(event.value) if plain else event.value
    return ScalarNode(line, value, event.value, plain=plain)


def _resolve(text: str) -> Scalar:
    if text in _NULL:
        return None
    if text in _BOOL:
        return _BOOL[text]
    if _INT.fullmatch(text):
        return int(text, 0 if text[1:2] in {"x", "o"} else 10)
    if _FLOAT.fullmatch(text):
        return float(text.replace(".", "", 1) if text[-1] in "fFnN" else text)
    return text
