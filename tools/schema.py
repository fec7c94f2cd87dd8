"""Write eap/config/plant.schema.json: the JSON Schema of plant files, for editors.

    python -m tools.schema            # writes the file
    python -m tools.schema --check    # exits with 1 when it is not as structs and page say

Keys, types and ranges are those of the structs, descriptions those of docs/plant-file.md.  The
schema accepts every file whose keys, types and ranges the loader accepts; ``eapctl check`` alone
checks references between the parts of a file.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

import msgspec

from eap.config.plant_sections import PlantFile
from eap.config.structs import Section
from eap.ids import NetId

Schema: TypeAlias = dict[str, Any]

_ROOT = Path(__file__).resolve().parent.parent
FILE = _ROOT / "eap" / "config" / "plant.schema.json"
PAGE = _ROOT / "docs" / "plant-file.md"

_TEXT = {"$ref": "#/$defs/Text"}
_NUMBER = r"0*(25[0-5]|2[0-4]\d|1?\d?\d)"
_SHARED = {
    # The loader takes a text as it is written, such as 1.0 or true.
    "Text": {"type": ["string", "number", "boolean"]},
    "NetId": {"type": "string", "pattern": rf"^{_NUMBER}(\.{_NUMBER}){{5}}$"},
}
_ROW = re.compile(r"^\| (`\w+`(?:, `\w+`)*) \|[^|]*\| (.*) \|$")
_LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
_LONGEST = 400
"""Characters of a description; the page has the rest."""


def render() -> str:
    """Return the schema as JSON text, a line for each key."""
    (root,), parts = msgspec.json.schema_components([PlantFile], schema_hook=_custom)
    sections = {each.__name__: each for each in _sections(Section)}
    structs = {name: _struct(part, sections) for name, part in parts.items()}
    _describe(structs, _tables(PAGE.read_text()))
    structs[PlantFile.__name__]["patternProperties"] = {"^x-": {}}
    shorts = {name: each.SHORT for name, each in sections.items() if each.SHORT}
    found = {name: _with_short(part, shorts.get(name, "")) for name, part in structs.items()}
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Plant file"}
    return "\n".join(_lines(head | root, found | _SHARED)) + "\n"


def _custom(kind: type) -> Schema:
    if kind is NetId:
        return {"$ref": "#/$defs/NetId"}
    raise NotImplementedError(kind)


def _sections(base: type[Section]) -> Iterator[type[Section]]:
    """Yield all subclasses of *base*."""
    for each in base.__subclasses__():
        yield each
        yield from _sections(each)


def _struct(part: Schema, sections: dict[str, type[Section]]) -> Schema:
    """Return the schema of one struct or enum."""
    if "properties" not in part:
        return part
    # A section has its path; the variable that a source fills is the source's key.
    internal = "at" if part["title"] in sections else "variable"
    keys = {key: _value(kind) for key, kind in part["properties"].items() if key != internal}
    return {
        "description": _plain(part.get("description", "")),
        "type": "object",
        "required": [key for key in part["required"] if key != internal],
        "additionalProperties": False,
        "properties": keys,
    }


def _value(kind: Any) -> Any:
    """Return the schema of one value, as the loader reads it."""
    if not isinstance(kind, dict):
        return kind
    if kind.get("type") == "string":
        return _TEXT
    found = {
        key: [_value(each) for each in value] if key == "anyOf" else _value(value)
        for key, value in kind.items()
        if key not in {"default", "discriminator"}
    }
    if kind.get("type") in {"array", "object"}:  # a key without a value is an empty one
        found["type"] = [kind["type"], "null"]
    if type(kind.get("default")) in {int, float, bool}:
        found["default"] = kind["default"]
    return found


def _with_short(part: Schema, short: str) -> Schema:
    """Return *part*, or instead of it the value of its key *short*."""
    if not short:
        return part
    value = {key: each for key, each in part["properties"][short].items() if key != "default"}
    return {"description": part.pop("description"), "anyOf": [value, part]}


def _tables(page: str) -> Iterator[dict[str, str]]:
    """Yield the tables of the page: the descriptions of the keys of a section."""
    table: dict[str, str] = {}
    for line in page.splitlines():
        if match := _ROW.match(line):
            names, text = match.groups()
            table |= dict.fromkeys(re.findall(r"\w+", names), _shortened(_plain(text)))
        elif table and not line.startswith("|"):
            yield table
            table = {}


def _describe(structs: dict[str, Schema], tables: Iterator[dict[str, str]]) -> None:
    """Enter the descriptions of each table in the smallest structs that have its keys."""
    keyed = {name: part["properties"] for name, part in structs.items() if "properties" in part}
    for table in tables:
        fitting = [keys for keys in keyed.values() if table.keys() <= keys.keys()]
        least = min(map(len, fitting), default=0)
        for keys in fitting:
            if len(keys) == least:
                for name, text in table.items():
                    keys[name] = {"description": text} | keys[name]


def _plain(text: str) -> str:
    """Return *text* without its marks of Markdown."""
    return " ".join(_LINK.sub(r"\1", text).replace("`", "").replace("*", "").split())


def _shortened(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST].rpartition(' ')[0]} …"


def _lines(head: Schema, parts: Schema) -> Iterator[str]:
    """Yield the lines of the file: short enough to be compared and merged key by key."""
    yield "{"
    yield from (f"  {_json(key)}: {_json(value)}," for key, value in head.items())
    yield '  "$defs": {'
    ends = [*[","] * (len(parts) - 1), ""]
    for (name, part), end in zip(parts.items(), ends, strict=True):
        yield f"    {_json(name)}: {_part_text(part)}{end}"
    yield "  }"
    yield "}"


def _part_text(part: Schema) -> str:
    """Return the text of one struct, with a line for each key."""
    inner = part["anyOf"][1] if "anyOf" in part else part
    if not inner.get("properties"):
        return _json(part)
    keys = ",\n".join(
        f"      {_json(key)}: {_json(kind)}" for key, kind in inner["properties"].items()
    )
    mark = '"properties": {}'
    text = _json(
        part | {"anyOf": [part["anyOf"][0], inner | {"properties": {}}]}
        if "anyOf" in part
        else part | {"properties": {}}
    )
    before, _, after = text.partition(mark)
    return f'{before}"properties": {{\n{keys}\n    }}{after}'


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def main(arguments: list[str]) -> int:
    """Write or check the file; return the exit status."""
    text = render()
    if arguments != ["--check"]:
        FILE.write_text(text)
    elif not FILE.exists() or FILE.read_text() != text:
        print(
            f"{FILE.relative_to(_ROOT)}: not as the structs of plant files and docs/plant-file.md"
            " say; write it: python -m tools.schema"
        )
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
