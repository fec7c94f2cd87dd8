"""Slaves, objects and IDNs as tables and lines for people."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeAlias

from rich.text import Text

from eap.cli.table import Column, TextTable
from eap.cli.words import count, duration
from eap.ids import ObjectId

Row: TypeAlias = dict[str, Any]

_SHOWN_OCTETS = 32
_MANY_SLAVES = 16
"""Of more slaves only those with errors are shown."""
_COMMAND_STATES = {0x0: "idle", 0x3: "done", 0x7: "executing", 0xF: "failed"}
_COUNTERS = ("invalid_frames", "physical", "forwarded", "lost_links")


def scan_tables(rows: Iterable[Row], faults: Sequence[str]) -> Iterator[TextTable | Text]:
    """Yield the table of a scan, and the lines *faults* that say what is wrong with slaves."""
    table = TextTable(
        "Slave",
        "Name",
        Column("Vendor", rank=3),
        "Product",
        Column("Revision", rank=2),
        Column("Serial", rank=4),
        Column("Alias", rank=5),
        "State",
        Column("Mailbox", rank=1, wraps=True),
    )
    for row in rows:
        numbers = (f"0x{row[key]:X}" for key in ("vendor", "product", "revision"))
        table.add_row(
            str(row["address"]),
            row["name"],
            *numbers,
            str(row["serial"]),
            str(row["alias"] or ""),
            _state(row["state"]),
            "?" if row["mailbox"] is None else " ".join(row["mailbox"]),
        )
    yield table
    if faults:
        yield Text()
    yield from map(Text, faults)


def state_table(rows: Iterable[Row]) -> TextTable:
    """Return the table of the slaves' states."""
    table = TextTable("Slave", "Name", "State", Column("Reason", wraps=True))
    for row in rows:
        table.add_row(str(row["address"]), row["name"], _state(row["state"]), _reason(row))
    return table


def diagnosis_tables(
    found: Row, now_s: float, *, is_full: bool = False
) -> Iterator[TextTable | Text]:
    """Yield the table of all ports, and below it what is and what was wrong.

    Args:
        found: The diagnosis.
        now_s: Unix time.
        is_full: Whether slaves without errors are shown where there are many.
    """
    slaves = found["slaves"]
    shown = slaves
    if len(slaves) > _MANY_SLAVES and not is_full:
        lasting = [row for row in found["findings"] if not row["is_over"]]
        first = {each["address"] for row in lasting for each in row["slaves"][:1]}
        shown = [row for row in slaves if row["address"] in first or _has_errors(row)]
    if shown:
        yield _port_table(shown)
    if len(shown) < len(slaves):
        rest = count(len(slaves) - len(shown), "slave")
        yield Text(f"not shown: {rest} without errors of their own (--full)", style="dim")
    yield Text()
    frames = found["frames"]
    yield Text(
        f"{count(frames['sent'], 'frame')} sent, {frames['late']} late, {frames['lost']} lost,"
        f" {frames['retried']} sent again\nround trip {duration(frames['round_trip_us'])},"
        f" time-out {duration(frames['timeout_us'])}"
    )
    for row in found["findings"]:
        yield Text(finding_line(row, now_s), style="dim" if row["is_over"] else "red")


def finding_line(row: Row, now_s: float) -> str:
    """Return one finding as a line: what is or was wrong, since or until when, what to do."""
    if not row["is_over"]:
        since = "" if row["since"] is None else f"since {_ago(row['since'], now_s)} ago: "
        return f"{since}{row['what']}" + (f"; {row['advice']}" if row["advice"] else "")
    until = "before the master looked"
    if row["until"] is not None:
        until = f"until {_ago(row['until'], now_s)} ago"
    return f"was, {until}: {row['what']}; --reset clears this"


def _ago(at_s: float, now_s: float) -> str:
    return duration(max(0, round((now_s - at_s) * 1e6)))


def _has_errors(row: Row) -> bool:
    return any(port[key] for port in row["ports"] for key in _COUNTERS)


def _port_table(slaves: Iterable[Row]) -> TextTable:
    table = TextTable(
        "Slave",
        Column("Name", rank=2),
        "State",
        "Port",
        Column("Open", rank=3),
        Column("CRC", is_number=True),
        Column("RX", is_number=True),
        Column("Forwarded", rank=1, is_number=True),
        Column("Lost link", is_number=True),
    )
    for row in slaves:
        state = row["state"] if row["answers"] else None
        first = (str(row["address"]), row["name"], _state(state))
        for port in row["ports"] or [{}]:
            errors = [port.get(key, 0) for key in _COUNTERS]
            if port and not port["is_open"] and not any(errors):
                continue
            is_open = ("yes" if port["is_open"] else "no") if port else ""
            numbers = (str(each or "") for each in errors)
            table.add_row(*first, str(port.get("port", "")), is_open, *numbers)
            first = ("", "", Text())
    return table


def eeprom_lines(content: Row, image: bytes) -> Iterator[str]:
    """Yield what an EEPROM says, then its octets."""
    yield f"slave {content['address']}: {content['name'] or 'without a name'}"
    for key in ("vendor", "product", "revision", "serial"):
        yield f"  {key:9} 0x{content[key]:08X}"
    intact = "right" if content["intact"] else "WRONG"
    kinds = ", ".join(f"{each['type']} ({each['octets']})" for each in content["categories"])
    yield f"  check sum {intact}; {content['octets']} bytes"
    yield f"  categories (bytes) {kinds or 'none'}"
    for offset in range(0, len(image), 16):
        yield f"{offset:04x}  {image[offset : offset + 16].hex(' ')}"


def value_line(row: Row) -> str:
    """Return an entry and its value."""
    octets = bytes.fromhex(row["data"])
    if row["value"] is None:
        return f"{entry_name(row)} = [{octets.hex(' ')}] ({count(len(octets), 'octet')})"
    kind = f" {row['type']}" if row["type"] else ""
    return f"{entry_name(row)} ={kind} {_value(row)}"


def entry_name(row: Row) -> str:
    """Return index and subindex as people write them."""
    return str(ObjectId(row["index"], row["subindex"]))


def object_table(rows: Iterable[Row]) -> TextTable:
    """Return the table of objects."""
    table = TextTable(
        "Index",
        Column("Name", wraps=True),
        Column("Kind", rank=1),
        Column("Subindexes", rank=2, is_number=True),
    )
    for row in rows:
        top = f"{row['max_subindex']:X}" if row["max_subindex"] else ""
        table.add_row(f"0x{row['index']:04X}", row["name"], row["code"], top)
    return table


def dump_table(rows: Iterable[Row]) -> TextTable:
    """Return the table of all entries with their values."""
    table = TextTable(
        "Entry",
        Column("Name", wraps=True),
        Column("Type", rank=1),
        Column("Access", rank=2),
        Column("Value", wraps=True),
    )
    for row in rows:
        own, whole = row["name"], row["object"]
        name = own if own == whole or not own else f"{whole}: {own}"
        access = row.get("access", "")
        table.add_row(
            entry_name(row), name or whole, row.get("type") or "", access, dumped_value(row)
        )
    return table


def dumped_value(row: Row) -> Text:
    """Return the value of an entry, or why there is none."""
    if "error" in row:
        return Text(row["error"], style="red")
    return Text(_value(row) if row["data"] is not None else "")


def idn_lines(row: Row) -> Iterator[str]:
    """Yield an IDN and what else is known of it."""
    unit = f" {row['unit']}" if row["unit"] else ""
    yield f"{row['idn']} = {_plain(row['value'])}{unit}"
    shown = {key: row[key] for key in ("name", "minimum", "maximum", "default")}
    shown["attribute"] = _attribute(row)
    state = row["data_state"]
    if state is not None:
        word = f" ({_COMMAND_STATES.get(state, 'unknown')})" if row["is_command"] else ""
        shown["data state"] = f"0x{state:04X}{word}"
    for key, value in shown.items():
        if value is not None:
            yield f"  {key:10} {_plain(value)}"


def idn_table(rows: Iterable[Row]) -> TextTable:
    """Return the table of IDNs."""
    table = TextTable("IDN", Column("Name", wraps=True))
    for row in rows:
        table.add_row(row["idn"], row["name"])
    return table


def _state(name: str | None) -> Text:
    if name is None:
        return Text("no answer", style="red")
    return Text(name, style="red" if name.endswith("ERROR") else "")


def _reason(row: Row) -> str:
    return f"{row['reason']} (0x{row['code']:04X})" if row["code"] else str(row["reason"])


def _attribute(row: Row) -> str:
    """Return how an IDN's value is to be read, and where it cannot be written."""
    parts = [row["display"].lower(), count(row["octets"], "octet")]
    if row["is_list"]:
        parts[1] += " each, a list"
    if row["decimals"]:
        parts.append(count(row["decimals"], "decimal"))
    if row["factor"] != 1:
        parts.append(f"factor {row['factor']}")
    if row["is_command"]:
        parts.append("a procedure command")
    if row["protected_in"]:
        parts.append(f"read only in {', '.join(row['protected_in'])}")
    return ", ".join(parts)


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return str(value)


def _value(row: Row) -> str:
    value = row["value"]
    octets = bytes.fromhex(row["data"])
    if value is None or value == row["data"]:
        more = f" … ({len(octets)} octets)" if len(octets) > _SHOWN_OCTETS else ""
        return f"[{octets[:_SHOWN_OCTETS].hex(' ')}{more}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return f"{value} (0x{int.from_bytes(octets, 'little'):0{2 * len(octets)}X})"
    return str(value)
