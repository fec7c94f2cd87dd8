"""Conversion of a document tree to structs, reporting everything that does not fit.

msgspec stops at the first error, so the walk is ours and msgspec only describes the structs.  An
item that cannot be read is left out and its name kept, so that references to it are not blamed.
A key with a typing error is reported and then read as the one that was meant.
"""

from __future__ import annotations

from functools import cache
from math import isfinite
from typing import Any, TypeVar

from msgspec import inspect

from eap.config.document import Node, ScalarNode
from eap.config.finding import FindingReport, one_of
from eap.config.structs import NO_NET_ID, PlantFile, Section
from eap.ids import NetId
from eap.suggest import nearest, suggest

T = TypeVar("T")

_UNITS = {"us": " of microseconds", "ms": " of milliseconds"}


_NULLS = frozenset(("null", "~"))
"""Said on purpose; an empty value may be a value forgotten."""


class _BrokenError(Exception):
    """The value was reported and cannot be used."""

    number: int | None = None
    """The number if it is only out of range: good enough to go on checking with."""


def convert(root: Node, report: FindingReport) -> PlantFile | None:
    """Return what *root* describes without the items that were reported; None if it is no plant."""
    return convert_to(PlantFile, root, report, "plant")


def convert_to(kind: type[T], root: Node, report: FindingReport, what: str) -> T | None:
    """Return what *root* describes as *kind*; None if it is none.  *what* is its name in findings.

    Items that were reported are left out.
    """
    report.lines[""] = root.line
    try:
        described = _describe_type(kind)  # type: ignore[arg-type]  # classes are hashable
        found: T = _Converter(report).value(root, described, "", what)
    except _BrokenError:
        return None
    return found


@cache
def _describe_type(kind: type) -> inspect.Type:
    """Return what msgspec knows of *kind*; finding out takes longer than reading most files."""
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

    def _refuse(self, node: Node, path: str, key: str, expected: str) -> _BrokenError:
        match node.value:
            case dict():
                shown = "is a mapping"
            case list():
                shown = "is a list"
            case None:
                shown = "has no value"
            case value:
                shown = f"is {value!r}"
        self._report.add(path, f"{key} {shown}", expected)
        return _BrokenError()

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
        lists = [each for each in kinds if isinstance(each, inspect.VarTupleType)]
        return (
            self._flag_or_items(node, lists[0], path, key)
            if lists
            else self._plain(node, path, key)
        )

    def _flag_or_items(
        self, node: Node, kind: inspect.VarTupleType, path: str, key: str
    ) -> bool | tuple[Any, ...]:
        if isinstance(node.value, bool):
            return node.value
        if not isinstance(node.value, list):
            raise self._refuse(node, path, key, "true, false or a list")
        return self._items(node, kind.item_type, path, key)

    def _tagged(self, node: Node, structs: list[inspect.StructType], path: str, key: str) -> Any:
        tags = {str(each.tag): each for each in structs}
        if not isinstance(node.value, dict) or "kind" not in node.value:
            raise self._refuse(node, path, key, f"a mapping with a kind ({', '.join(tags)})")
        tag = str(getattr(node.value["kind"][1], "text", ""))
        if tag not in tags:
            self._enter(node, path)
            message = f"unknown kind {tag!r}{suggest(tag, tags)}"
            self._report.add(f"{path}.kind", message, one_of(tags))
            raise _BrokenError
        # The key of a source is the variable it fills.
        values = {
            **{name: entry for name, entry in node.value.items() if name != "kind"},
            "variable": (node.line, ScalarNode(node.line, key, key, plain=False)),
        }
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
        if short and isinstance(node.value, bool | int | float | str):
            node = Node(node.line, {short: (node.line, node)})
        if not isinstance(node.value, dict):
            known = ", ".join(each.encode_name for each in kind.fields if each.required)
            raise self._refuse(node, path, key, f"a mapping{f' with {known}' if known else ''}")
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
            except _BrokenError as exc:
                if field.required and exc.number is not None:
                    values[field.name] = exc.number
                else:
                    broken |= field.required
        if broken:
            raise _BrokenError
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
            self._report.add(where, message, one_of(shown), line=line)
            meant = nearest(name, missing)
            if meant is not None:
                given[meant] = node
                self._report.enter(f"{path}.{meant}" if path else meant, line, node)
        return given

    def _items(self, node: Node, kind: inspect.Type, path: str, key: str) -> tuple[Any, ...]:
        if node.value is None:
            return ()
        if not isinstance(node.value, list):
            raise self._refuse(node, path, key, "a list")
        found = []
        for position, item in enumerate(node.value):
            where = f"{path}[{position}]"
            self._report.enter(where, item.line, item)
            try:
                found.append(self.value(item, kind, where, f"item {position + 1} of {key}"))
            except _BrokenError:
                self._remember(item)
        return tuple(found)

    def _entries(self, node: Node, kind: inspect.Type, path: str, key: str) -> dict[str, Any]:
        if node.value is None:
            return {}
        if not isinstance(node.value, dict):
            raise self._refuse(node, path, key, "a mapping from names")
        self._enter(node, path)
        found = {}
        for name, (_, item) in node.value.items():
            try:
                found[name] = self.value(item, kind, f"{path}.{name}", name)
            except _BrokenError:
                self._report.broken.add(name)
        return found

    def _remember(self, item: Node) -> None:
        if isinstance(item.value, dict) and "name" in item.value:
            self._report.broken.add(str(item.value["name"][1].value))

    def _scalar(self, node: Node, kind: inspect.Type, path: str, key: str) -> Any:
        value = node.value
        match kind:
            case inspect.StrType() if isinstance(node, ScalarNode) and value is not None:
                return node.text
            case inspect.BoolType() if isinstance(value, bool):
                return value
            case inspect.IntType() if isinstance(value, int) and not isinstance(value, bool):
                low, high = kind.ge, kind.le
                if (low is None or value >= low) and (high is None or value <= high):
                    return value
                out_of_range = self._refuse(node, path, key, _describe(kind, key))
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
        raise self._refuse(node, path, key, _describe(kind, key))

    def _plain(self, node: Node, path: str, key: str) -> Any:
        """Read a value whose type only the data type of its variable knows."""
        if isinstance(node.value, list):
            return [self._plain(item, path, f"an element of {key}") for item in node.value]
        if node.value is None or isinstance(node.value, dict):
            raise self._refuse(node, path, key, "a value, or a list of values for an array")
        return node.value


def read_net_id(text: str, path: str, report: FindingReport) -> NetId:
    """Return the NetID of a station or port; report at *path* why it is none, and go on."""
    try:
        return NetId.parse(text)
    except ValueError as exc:
        report.add(path, f"net_id: {exc}", "an AMS NetID such as 5.23.91.23.1.1")
        return NO_NET_ID


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
