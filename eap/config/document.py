"""Reading of a plant file: YAML as a tree with line numbers, converted to structs.

The tree is built from the events of the parser without recursion, because the usual composer
follows hostile nesting down the C stack.  Scalars follow YAML 1.2 (``on`` and ``10:20`` are texts),
merge keys (``<<``) and anchors work, duplicate keys are findings, and the expansion of aliases is
bounded.

The conversion walks the tree itself and takes only the description of the structs from msgspec,
because msgspec stops at the first error.  An item that cannot be read is left out and its name
kept, so that references to it are no findings.  A key with a typing error is reported and then read
as the key that is nearest to it.
"""

from __future__ import annotations

import re
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import yaml
from msgspec import inspect

from eap.config.finding import FindingReport, one_of
from eap.config.plant_sections import PlantFile
from eap.config.structs import INVALID_NET_ID, Section
from eap.ids import NET_ID, NetId
from eap.suggest import nearest, suggest

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
    try:
        text = _text(path)
    except _UnreadableError as exc:
        report.add("", str(exc), exc.expected, line=exc.line)
        return None
    return parse(text, report)


def parse(text: str, report: FindingReport) -> Node | None:
    """Return the tree of a YAML text; None, with findings, if it has none."""
    try:
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
        # A pipe would block the reader, a device might never end.
        if not path.is_file():
            raise _UnreadableError(0, "is not a regular file", "a YAML file")
        with path.open("rb") as file:
            # One byte more than allowed: the size of the file could change between a check and the
            # read.
            octets = file.read(MAX_FILE + 1)
    except (OSError, ValueError) as exc:  # ValueError: a NUL in the path
        reason = exc.strerror if isinstance(exc, OSError) else None
        raise _UnreadableError(0, f"cannot be read: {reason or exc}", "a readable file") from None
    if len(octets) > MAX_FILE:
        raise _UnreadableError(0, "is too large", f"at most {MAX_FILE >> 20} MiB")
    try:
        # Windows editors put a byte order mark in front; it is no part of the first key.
        return octets.decode("utf-8-sig")
    except UnicodeDecodeError as exc:
        line = octets.count(b"\n", 0, exc.start) + 1
        raise _UnreadableError(
            line, f"byte {octets[exc.start]:#04x} is not UTF-8", "UTF-8"
        ) from None


def _tab_in(text: str, line: int) -> str:
    """Return the position of a tab in *line* that YAML does not allow; empty without one."""
    lines = text.split("\n")
    written = lines[line - 1] if 0 < line <= len(lines) else ""
    if _TAB_INDENT.match(written):
        return "begins with a tab"
    return "has a tab behind '-', '?' or ':'" if _TAB_BEHIND_SIGN.search(written) else ""


class _OpenCollection:
    """A list or mapping that is still open."""

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
        self._stack: list[_OpenCollection] = []
        self._root: Node | None = None

    def build(self, text: str) -> Node:
        for event in yaml.parse(text, Loader=yaml.CSafeLoader):
            self._handle(event)
        if self._root is None:
            raise _UnreadableError(1, "the file is empty", "a plant file (docs/plant-file.md)")
        return self._root

    def _handle(self, event: yaml.Event) -> None:
        line = event.start_mark.line + 1 if event.start_mark else 0
        match event:
            case yaml.DocumentStartEvent() if self._root is not None:
                raise _UnreadableError(
                    line, "a second YAML document begins", "one document in a file"
                )
            # The alias shares the node: its findings are then known to have one cause.
            case yaml.AliasEvent(anchor=anchor):
                if (node := self._anchors.get(anchor)) is None:
                    raise _UnreadableError(
                        line, f"no anchor &{anchor} ends before this", "a known anchor"
                    )
                self._add_node(node, None)
            case yaml.ScalarEvent():
                self._add_node(_scalar(event, line), event.anchor)
            case yaml.CollectionStartEvent():
                if len(self._stack) >= MAX_DEPTH:
                    raise _UnreadableError(line, "nested too deeply", f"at most {MAX_DEPTH} levels")
                mapping = isinstance(event, yaml.MappingStartEvent)
                self._stack.append(_OpenCollection(line, event.anchor, mapping=mapping))
            case yaml.CollectionEndEvent():
                done = self._stack.pop()
                self._add_node(self._close(done), done.anchor)

    def _add_node(self, node: Node, anchor: str | None) -> None:
        if anchor is not None:
            self._anchors[anchor] = node
        if self._stack:
            self._stack[-1].items.append(node)
        else:
            self._root = node

    def _close(self, done: _OpenCollection) -> Node:
        value: list[Node] | dict[str, tuple[int, Node]]
        if done.mapping:
            value = self._mapping(done.items)
            weight = 1 + sum(node.weight for _, node in value.values())
        else:
            value = done.items
            weight = 1 + sum(node.weight for node in value)
        # Every use of an alias counts: nine levels of nine aliases are 387 million values.
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
        # The first source that has a key wins, and own keys win over all (YAML merge key).
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
# At most 100 digits: int() of a long text takes time that grows with its square.
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
    # Base 10 unless 0x or 0o: with base 0 Python refuses 010, which YAML 1.2 reads as 10.
    if _INT.fullmatch(text):
        return int(text, 0 if text[1:2] in {"x", "o"} else 10)
    if _FLOAT.fullmatch(text):
        return float(text.replace(".", "", 1) if text[-1] in "fFnN" else text)
    return text


T = TypeVar("T")

_MAIN_KEYS = {"plant": frozenset(("plant", "stations")), "bus": frozenset(("bus", "slaves"))}
_RUN_BY = {"plant": "eapctl run", "bus": "eapctl sim run"}
_UNITS = {"us": " of microseconds", "ms": " of milliseconds"}


_NULLS = frozenset(("null", "~"))
"""Explicit nulls; an empty value may be a forgotten one."""


class _ReportedError(Exception):
    """The value was reported and cannot be used."""

    number: int | None = None
    """The number if it is only out of range, so that the checks can continue with it."""


def kind_of(root: Node) -> str:
    """Return plant or bus, as the main keys of a file say; empty if they do not."""
    given = set(root.value) if isinstance(root.value, dict) else set()
    fitting = [kind for kind, keys in _MAIN_KEYS.items() if given & keys]
    return fitting[0] if len(fitting) == 1 else ""


def convert(root: Node, report: FindingReport) -> PlantFile | None:
    """Convert *root* to a plant file without the reported items; None if it is not a plant."""
    return convert_to(PlantFile, root, report, "plant")


def convert_to(kind: type[T], root: Node, report: FindingReport, what: str) -> T | None:
    """Convert *root* to *kind* without the reported items; None if it cannot be read.

    *what* is plant or bus, and names it in findings.
    """
    report.lines[""] = root.line
    if (other := kind_of(root)) not in {"", what}:
        # One finding: those about its keys would say nothing of the mistake.
        expected = f"a {what} file; '{_RUN_BY[other]}' runs a {other} file"
        report.add("", f"it is a {other} file", expected, line=0)
        return None
    try:
        described = _describe_type(kind)  # type: ignore[arg-type]  # classes are hashable
        found: T = _Converter(report).value(root, described, "", what)
    except _ReportedError:
        return None
    return found


@cache
def _describe_type(kind: type) -> inspect.Type:
    """Return the description of *kind* by msgspec, cached because it takes long to make."""
    return inspect.type_info(kind)


class _Converter:
    def __init__(self, report: FindingReport) -> None:
        self._report = report

    def value(self, node: Node, kind: inspect.Type, path: str, key: str) -> Any:
        """Read *node* as *kind*; raise _BrokenError after having reported why not."""
        match kind:
            case inspect.UnionType():
                return self._union(node, kind, path, key)
            case inspect.StructType():
                return self._struct(node, kind, path, key)
            case inspect.VarTupleType():
                return self._items(node, kind.item_type, path, key)
            case inspect.DictType():
                return self._entries(node, kind.value_type, path, key)
        return self._scalar(node, kind, path, key)

    def _unexpected(self, node: Node, path: str, key: str, expected: str) -> _ReportedError:
        match node.value:
            case dict():
                shown = "is a mapping"
            case list():
                shown = "is a list"
            case None:
                shown = "has no value"
            case bool():
                shown = f"is {str(node.value).lower()}"
            case value:
                shown = f"is {value!r}"
        self._report.add(path, f"{key} {shown}", expected)
        return _ReportedError()

    def _union(self, node: Node, kind: inspect.UnionType, path: str, key: str) -> Any:
        kinds = [each for each in kind.types if not isinstance(each, inspect.NoneType)]
        structs = [each for each in kinds if isinstance(each, inspect.StructType)]
        if len(kinds) < len(kind.types) and getattr(node, "text", "") in _NULLS:
            return None
        if len(kinds) == 1:
            return self.value(node, kinds[0], path, key)
        if len(structs) == len(kinds):
            return self._tagged(node, structs, path, key)
        if structs:
            is_struct = isinstance(node.value, dict)
            return self.value(node, structs[0] if is_struct else inspect.StrType(), path, key)
        return self._by_shape(node, kinds, path, key)

    def _by_shape(self, node: Node, kinds: list[inspect.Type], path: str, key: str) -> Any:
        """Read a value that is a list, a mapping or a scalar in the file."""
        lists = [each for each in kinds if isinstance(each, inspect.VarTupleType)]
        if lists:
            return self._list_or_other(node, lists[0], kinds, path, key)
        mappings = [each for each in kinds if isinstance(each, inspect.DictType)]
        if all(isinstance(each.value_type, inspect.AnyType) for each in mappings):
            return self._plain(node, path, key)
        is_text = isinstance(node, ScalarNode) and node.value is not None
        return self.value(node, inspect.StrType() if is_text else mappings[0], path, key)

    def _list_or_other(
        self,
        node: Node,
        listed: inspect.VarTupleType,
        kinds: list[inspect.Type],
        path: str,
        key: str,
    ) -> Any:
        """Read *node* as a list, or as the other one of two *kinds*."""
        if isinstance(node.value, list):
            return self._items(node, listed.item_type, path, key)
        (other,) = (each for each in kinds if each is not listed)
        match other, node.value:
            case (inspect.BoolType(), bool()) | (inspect.DictType(), dict()):
                return self.value(node, other, path, key)
            case (inspect.StrType(), value) if not isinstance(value, dict | None):
                return self.value(node, other, path, key)
        words = {inspect.BoolType: "true, false", inspect.DictType: "a mapping"}
        raise self._unexpected(node, path, key, f"{words.get(type(other), 'a text')} or a list")

    def _tagged(self, node: Node, structs: list[inspect.StructType], path: str, key: str) -> Any:
        tags = {str(each.tag): each for each in structs}
        if not isinstance(node.value, dict) or "kind" not in node.value:
            raise self._unexpected(node, path, key, f"a mapping with a kind ({', '.join(tags)})")
        tag = str(getattr(node.value["kind"][1], "text", ""))
        if tag not in tags:
            self._enter(node, path)
            message = f"unknown kind {tag!r}{suggest(tag, tags)}"
            self._report.add(f"{path}.kind", message, one_of(tags))
            raise _ReportedError
        values = {name: entry for name, entry in node.value.items() if name != "kind"}
        if any(field.name == "variable" for field in tags[tag].fields):
            # The key of a source is the variable it fills.
            values["variable"] = (node.line, ScalarNode(node.line, key, key, plain=False))
            if "variable" in node.value:
                self._report.add(
                    path, "unknown key 'variable'", "the variable as the key of its source"
                )
        return self._struct(Node(node.line, values), tags[tag], path, key)

    def _enter(self, node: Node, path: str) -> None:
        if isinstance(node.value, dict):
            for name, (line, entry) in node.value.items():
                self._report.enter(f"{path}.{name}" if path else name, line, entry)

    def _struct(self, node: Node, kind: inspect.StructType, path: str, key: str) -> Any:
        short = getattr(kind.cls, "SHORT", "")
        # SHORT names the key that a plain value stands for.
        if short and isinstance(node.value, bool | int | float | str):
            node = Node(node.line, {short: (node.line, node)})
        if not isinstance(node.value, dict):
            raise self._unexpected(node, path, key, _mapping_of(kind))
        self._enter(node, path)
        own = issubclass(kind.cls, Section)
        fields = {each.encode_name: each for each in kind.fields if not (own and each.name == "at")}
        given = self._known(node.value, kind, list(fields), path)
        values: dict[str, Any] = {"at": path} if own else {}
        broken = False
        for name, field in fields.items():
            where = f"{path}.{name}" if path else name
            if name not in given:
                if field.required:
                    self._report.add(path, f"{_title(given, key)} has no {name}", f"the key {name}")
                    broken = True
                continue
            try:
                values[field.name] = self.value(given[name], field.type, where, name)
            except _ReportedError as exc:
                if field.required and exc.number is not None:
                    values[field.name] = exc.number
                else:
                    # An optional key that is wrong has its finding; its section is still worth
                    # checking.
                    broken |= field.required
        if broken:
            raise _ReportedError
        return kind.cls(**values)

    def _known(
        self,
        entries: dict[str, tuple[int, Node]],
        kind: inspect.StructType,
        keys: list[str],
        path: str,
    ) -> dict[str, Node]:
        """Return the entries with known keys, after reporting the others."""
        given = {name: node for name, (_, node) in entries.items() if name in keys}
        shown = [name for name in keys if name != "variable"]
        for name, (line, node) in entries.items():
            if name in keys or (kind.cls is PlantFile and name.startswith("x-")):
                continue
            where = f"{path}.{name}" if path else name
            missing = [each for each in shown if each not in given]
            message = f"unknown key {name!r}{suggest(name, missing)}"
            homes = [each.encode_name for each in kind.fields if _has_key(each.type, name)]
            if homes:
                self._report.add(where, message, f"it under the key {homes[0]}", line=line)
                continue
            self._report.add(where, message, one_of(shown), line=line)
            meant = nearest(name, missing)
            if meant is not None:
                # Without it, one typing error would be reported again as a missing key.
                given[meant] = node
                self._report.enter(f"{path}.{meant}" if path else meant, line, node)
        return given

    def _items(self, node: Node, kind: inspect.Type, path: str, key: str) -> tuple[Any, ...]:
        if node.value is None:
            return ()
        if not isinstance(node.value, list):
            raise self._unexpected(node, path, key, "a list")
        found = []
        for position, item in enumerate(node.value):
            where = f"{path}[{position}]"
            self._report.enter(where, item.line, item)
            try:
                found.append(self.value(item, kind, where, f"item {position + 1} of {key}"))
            except _ReportedError:
                self._mark_broken(item)
        return tuple(found)

    def _entries(self, node: Node, kind: inspect.Type, path: str, key: str) -> dict[str, Any]:
        if node.value is None:
            return {}
        if not isinstance(node.value, dict):
            raise self._unexpected(node, path, key, "a mapping from names")
        self._enter(node, path)
        found = {}
        for name, (_, item) in node.value.items():
            try:
                found[name] = self.value(item, kind, f"{path}.{name}", name)
            except _ReportedError:
                # References to it would otherwise be findings of their own, one for each.
                self._report.broken.add(name)
        return found

    def _mark_broken(self, item: Node) -> None:
        if isinstance(item.value, dict) and "name" in item.value:
            self._report.broken.add(str(item.value["name"][1].value))

    def _scalar(self, node: Node, kind: inspect.Type, path: str, key: str) -> Any:
        value = node.value
        match kind:
            # The text as written: a name such as 0x10 or 1.0 must not become a number and back.
            case inspect.StrType() if isinstance(node, ScalarNode) and value is not None:
                return node.text
            case inspect.BoolType() if isinstance(value, bool):
                return value
            # In Python true is an int.
            case inspect.IntType() if isinstance(value, int) and not isinstance(value, bool):
                low, high = kind.ge, kind.le
                if (low is None or value >= low) and (high is None or value <= high):
                    return value
                out_of_range = self._unexpected(node, path, key, _describe(kind, key))
                out_of_range.number = value
                raise out_of_range
            case inspect.FloatType() if isinstance(value, int | float):
                if not isinstance(value, bool) and isfinite(value):
                    return float(value)
            case inspect.EnumType() if value in [each.value for each in kind.cls]:
                return kind.cls(value)
            case inspect.CustomType(cls=cls) if cls is NetId:
                if isinstance(node, ScalarNode) and value is not None:
                    return read_net_id(node.text, path, self._report)
        raise self._unexpected(node, path, key, _describe(kind, key))

    def _plain(self, node: Node, path: str, key: str) -> Any:
        """Read a value whose type depends on the data type of its variable."""
        if isinstance(node.value, list):
            return [self._plain(item, path, f"an element of {key}") for item in node.value]
        if isinstance(node.value, dict):
            return {name: self._plain(item, path, name) for name, (_, item) in node.value.items()}
        if node.value is None:
            raise self._unexpected(node, path, key, "a value, or a list of values for an array")
        return node.value


def read_net_id(text: str, path: str, report: FindingReport) -> NetId:
    """Return the NetID of a station or port; report an invalid one at *path*."""
    try:
        return NetId.parse(text)
    except ValueError:
        report.add(path, f"net_id: {text!r} is not an AMS NetID", NET_ID)
        return INVALID_NET_ID


def _has_key(kind: inspect.Type, name: str) -> bool:
    """Return whether *kind* is a section, or none, with the key *name*."""
    kinds = kind.types if isinstance(kind, inspect.UnionType) else (kind,)
    return any(
        name in (field.encode_name for field in each.fields if field.name != "at")
        for each in kinds
        if isinstance(each, inspect.StructType)
    )


_SHOWN_KEYS = 6


def _mapping_of(kind: inspect.StructType) -> str:
    """Return the expectation of a mapping with its required keys, or else its few keys."""
    keys = ", ".join(each.encode_name for each in kind.fields if each.required)
    if not keys and len(kind.fields) <= _SHOWN_KEYS:
        keys = "keys of " + ", ".join(e.encode_name for e in kind.fields if e.encode_name != "at")
    return f"a mapping with {keys}" if keys else "a mapping"


def _title(given: dict[str, Node], key: str) -> str:
    name = given["name"].value if "name" in given else None
    return f"{name!r}" if isinstance(name, str) else key


def _describe(kind: inspect.Type, key: str) -> str:
    match kind:
        case inspect.IntType():
            unit = _UNITS.get(key.rpartition("_")[2], "")
            bounds = f" from {kind.ge} to {kind.le}" if kind.ge is not None else ""
            return f"a whole number{unit}{bounds}"
        case inspect.FloatType():
            return f"a number{_UNITS.get(key.rpartition('_')[2], '')}"
        case inspect.BoolType():
            return "true or false"
        case inspect.EnumType():
            return one_of(str(each.value) for each in kind.cls)
    return "a text"
