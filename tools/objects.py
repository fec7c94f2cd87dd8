"""Write docs/objects.md: every object and sub-index of EAP ports and routers, from their tables.

    python -m tools.objects

A test compares the page with what this would write.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from eap.codec import datatypes
from eap.od.model import Access, Entry, ObjectCode
from eap.od.profiles import eap1000, router9000
from eap.od.profiles.table import CONFIG, OWN_TYPE, ProfileEntry, ProfileObject, to_text

_COLUMNS = (
    "Sub", "Name", "Type", "Bits", "Access", "Content", "Default", "Limits", "Unit", "Description",
)  # fmt: skip
PAGE = Path(__file__).resolve().parent.parent / "docs" / "objects.md"

_HEAD = """# Objects

Each EAP port of a station, and its router, is a device with an object dictionary. This page is
written by `python -m tools.objects` from the tables from which the dictionaries themselves are
made. [EAP port](#eap-port) · [Router](#router)

# EAP port

Modular device profile 5001, sub-profile 1000 (ETG.5001, ETG.1005); the tables are in
`eap/od/profiles/eap1000.py`. Commands call it `STATION/PORT`, and `STATION` the first one.

- **Access** is told for PreOp, SafeOp and Op: `r` read, `w` written, `-` neither. `rw r r` is
  configuration: it can be written in PreOp only and is kept; elsewhere a download is refused with
  0x08000022. Entries marked *c* can also be written in SafeOp and Op once their object says that it
  is changeable. *T* and *R* mark what can be mapped into sent and received PDOs.
- **Kept** configuration is what `plan`, `apply` and `rollback` compare and what survives a restart.
  *live* is what the running device shows, *computed* follows from other entries, *fixed* was given
  at the start. **Plant file** is the key of the [plant file](plant-file.md) that says the same;
  all others are keys within `stations`.
- Objects of **dynamic** ranges are made by a download to any sub-index of a free index and deleted
  by writing 0 to sub-index 0, in PreOp and as long as nothing refers to them. Writing 0 to
  sub-index 0 of a mapping empties it; its entries are written then, and sub-index 0 last.
- Sub-index 0 of ARRAY and RECORD is the highest sub-index; it can be written where there is a list
  at the end, and writing behind the end of a list makes it longer.
- The ranges, the meaning of the objects and the sub-indexes 3, 4 and 6 of process data come from
  public descriptions of the profile; the other sub-index tables are this project's own.
"""

_ROUTER = """
# Router

Modular device profile 5001, sub-profile 9000 (ETG.5001, ETG.1005); the tables are in
`eap/od/profiles/router9000.py`. Commands call it `STATION/router`; ADS clients find it at the NetID
of the station, AMS port 65535. Everything can be read in all states and nothing can be written. The
meaning of 0x8000 and 0xF000 comes from public descriptions; the sub-indexes and the routes are this
project's own (own format).
"""


def render() -> str:
    """Return the page."""
    return "".join([_HEAD, *_profile(eap1000.ALL), _ROUTER, *_profile(router9000.ALL)])


def _profile(rows: Sequence[ProfileObject]) -> Iterator[str]:
    yield "\n## Overview\n\n"
    yield from _overview(rows)
    for row in rows:
        yield "\n"
        yield from _object(row)


def _overview(rows: Sequence[ProfileObject]) -> Iterator[str]:
    yield "| Index | Object | Kind | Description |\n|---|---|---|---|\n"
    for row in rows:
        kind = f"{row.code.name}{', dynamic' if row.dynamic else ''}"
        yield f"| {_range(row)} | {_title(row)} | {kind} | {_cell(row.description)} |\n"


def _object(row: ProfileObject) -> Iterator[str]:
    yield f"## {_range(row)} {_title(row)}\n\n{row.code.name}"
    yield ", dynamic" if row.dynamic else ""
    yield f". {row.description}\n\n"
    columns = (*_COLUMNS, "Plant file") if row.section else _COLUMNS
    yield f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}\n"
    if row.code is not ObjectCode.VAR:
        count = ProfileEntry(0, "Highest sub-index", "USINT", row.count_access, _count_text(row),
                         row.fixed_count)  # fmt: skip
        yield _entry(count, row.section)
    for entry in row.entries:
        yield _entry(entry, row.section)


def _count_text(row: ProfileObject) -> str:
    texts = []
    if row.list_row:
        texts.append(f"At most {row.last_subindex}.")
    if row.mapping:
        texts.append("0 empties the mapping.")
    elif row.dynamic:
        texts.append("0 deletes the object.")
    return " ".join(texts)


def _entry(row: ProfileEntry, section: str = "") -> str:
    kind = None if row.kind == OWN_TYPE else datatypes.parse(row.kind)
    cells = (
        f"{row.subindex:02X} to {row.last:02X}" if row.last else f"{row.subindex:02X}",
        row.name.format(n="0…") if row.last else row.name,
        "of the variable" if kind is None else kind.text,
        "" if kind is None else str(kind.bit_length),
        _access(row),
        _content(row),
        _default(row),
        _limits(row),
        row.unit.replace("us", "µs"),
        row.description,
        *([f"`{section}.{row.key}`" if row.key else ""] if section else []),
    )
    return f"| {' | '.join(_cell(cell) for cell in cells)} |\n"


def _access(row: ProfileEntry) -> str:
    states = (
        (Access.READ_PREOP, Access.WRITE_PREOP),
        (Access.READ_SAFEOP, Access.WRITE_SAFEOP),
        (Access.READ_OP, Access.WRITE_OP),
    )
    rights = [
        ("r" if row.access & read else "") + ("w" if row.access & write else "") or "-"
        for read, write in states
    ]
    marks = [
        mark
        for mark, holds in (
            ("*c*", row.changeable),
            ("*T*", row.access & Access.TX_MAPPABLE),
            ("*R*", row.access & Access.RX_MAPPABLE),
        )
        if holds
    ]
    return " ".join([*rights, *marks])


def _content(row: ProfileEntry) -> str:
    if row.live:
        return "live"
    if row.derived:
        return "computed"
    if row.access & CONFIG == CONFIG:
        return "kept"
    return "command" if row.access & Access.WRITE_ANY else "fixed"


def _default(row: ProfileEntry) -> str:
    if row.live or row.derived or row.kind == OWN_TYPE:
        return ""
    entry = Entry(row.name, row.kind, row.access, row.default)
    text = to_text(row.form, entry.kind, entry.default)
    return text or "empty"


def _limits(row: ProfileEntry) -> str:
    if row.minimum is None and row.maximum is None:
        return ""
    return f"{row.minimum or 0} to {row.maximum}"


def _range(row: ProfileObject) -> str:
    first = f"0x{row.first:04X}"
    return first if row.first == row.last else f"{first} to 0x{row.last:04X}"


def _title(row: ProfileObject) -> str:
    return row.name.format(n="n")


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(render())
