"""Text views of ``eapctl bus``: slaves, faults, EEPROMs, objects and IDNs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from msgspec import UNSET

from eap.cli.output import Column, Styled, TextTable
from eap.ids import ObjectId
from eap.ops.bus_info import (
    BusScan,
    CounterReset,
    DiagnosedSlave,
    Diagnosis,
    EepromContent,
    SlaveStateRow,
    SlaveStates,
    fault_lines,
)
from eap.ops.bus_objects import (
    IdnElements,
    NamedIdn,
    SdoDumpEntry,
    SdoValue,
    SlaveObject,
)
from eap.ops.od import OdObjectRow
from eap.quantities import age, count, duration
from eap.runtime.bus_status import FindingRow
from eap.runtime.engine_messages import EoeReport, LockState

if TYPE_CHECKING:
    from eap.ops.scanned_bus import WrittenBus

ABSENT = "absent"
"""State of an optional slave that is not plugged in."""
_SHOWN_OCTETS = 32
_SHOWN_EMERGENCIES = 4
"""Emergencies of a slave that are shown without --full."""
_MANY_SLAVES = 16
"""Of more slaves only those with errors are shown."""
_COMMAND_STATES = {0x0: "idle", 0x3: "done", 0x7: "executing", 0xF: "failed"}


def scan_tables(found: BusScan) -> Iterator[TextTable | str]:
    """Yield the table of a scan, and a line for each fault of slaves.

    On a bus that is not as configured the expected slaves are beside those that are there.
    """
    expected = {each.address: each.name for each in found.expected}
    table = TextTable(
        "Slave",
        "Name",
        *(["Expected"] if expected else []),
        Column("Vendor", rank=3),
        "Product",
        Column("Revision", rank=2),
        Column("Serial", rank=4),
        Column("Alias", rank=5),
        "State",
        Column("Mailbox", rank=1, wraps=True),
    )
    for row in found.slaves:
        numbers = (f"0x{number:X}" for number in (row.vendor, row.product, row.revision))
        table.add_row(
            str(row.address),
            row.name,
            *([expected.pop(row.address, "")] if found.expected else []),
            *numbers,
            str(row.serial),
            str(row.alias or ""),
            Styled(ABSENT, style="dim") if row.is_absent else _state(row.state),
            "?" if row.mailbox is None else " ".join(row.mailbox),
        )
    for address, name in expected.items():
        table.add_row(str(address), "", name)
    yield table
    if found.fault:
        yield ""
        yield from found.fault.splitlines()
    if faults := fault_lines(found.slaves):
        yield ""
        yield from faults


def written_bus_view(done: WrittenBus) -> Iterator[TextTable | str]:
    """Yield the slaves of a bus file that was written, and differences from their descriptions."""
    table = TextTable("Slave", "Name", Column("Described by", wraps=True))
    for row in done.slaves:
        file = PurePath(row.file).name
        described = f"{file} ({row.device})" if row.file else "EEPROM and objects"
        table.add_row(str(row.address), row.name, described)
    yield table
    yield from (f"{row.name}: {note}" for row in done.slaves for note in row.notes)
    yield from done.faults
    yield f"\n{done.file} written: {count(len(done.slaves), 'slave')}"


def state_view(found: SlaveStates, note: str) -> Iterator[TextTable | str]:
    """Yield the table of the slaves' states, and *note* unless it is empty."""
    table = TextTable("Slave", "Name", "State", Column("Reason", wraps=True))
    for row in found.slaves:
        shown = Styled(ABSENT, style="dim") if row.is_absent else _state(row.state)
        table.add_row(str(row.address), row.name, shown, _reason(row))
    yield table
    if note:
        yield note


def reset_view(done: CounterReset) -> str:
    """Return the line of ``bus diag --reset``."""
    return f"error counters of {count(len(done.reset), 'slave')} cleared"


def diagnosis_view(
    found: Diagnosis, now_s: float, *, is_full: bool = False
) -> Iterator[TextTable | Styled | str]:
    """Yield the table of all ports, and below it present and past faults.

    Args:
        found: The diagnosis.
        now_s: Unix time.
        is_full: Show slaves without errors on long buses too.
    """
    shown = found.slaves
    if len(shown) > _MANY_SLAVES and not is_full:
        lasting = [row for row in found.findings if not row.is_over]
        # A cause may concern all slaves behind a break; its first one stands for them.
        first = {each.address for row in lasting for each in row.slaves[:1]}
        shown = [row for row in shown if row.address in first or _has_errors(row)]
    if shown:
        yield _port_table(shown)
    if rest := len(found.slaves) - len(shown):
        slaves = count(rest, "slave")
        yield Styled(f"not shown: {slaves} without errors (--full shows them)", style="dim")
    yield ""
    frames = found.frames
    yield (
        f"{count(frames.sent, 'frame')} sent, {frames.late} late, {frames.lost} lost,"
        f" {frames.retried} repeated\nround trip {duration(frames.round_trip_us)},"
        f" timeout {duration(frames.timeout_us)}"
    )
    if found.lock is not None:
        yield _lock_line(found.lock)
    if table := _emergency_table(found.slaves, now_s, is_full=is_full):
        yield ""
        yield table
    if found.eoe is not None:
        yield ""
        yield eoe_table(found.eoe)
    if found.absent:
        names = ", ".join(f"{each.name} ({each.address})" for each in found.absent)
        yield Styled(f"not plugged in: {names}", style="dim")
    for row in found.findings:
        yield Styled(finding_line(row, now_s), style="dim" if row.is_over else "red")


def _lock_line(lock: LockState) -> str:
    if lock.reference is None:
        return "cycle runs free: no slave with a distributed clock answers"
    state = "locked to" if lock.is_locked else "not locked yet to"
    return (
        f"cycle {state} the clock of slave {lock.reference}:"
        f" offset {lock.offset_ns / 1000:+.1f} µs, drift {lock.drift_ppb / 1000:+.1f} ppm\n"
        f"frames {duration(lock.lead_ns // 1000)} before SYNC0:"
        f" {lock.late} too late, {lock.early} too early"
    )


def _emergency_table(
    slaves: Sequence[DiagnosedSlave], now_s: float, *, is_full: bool
) -> TextTable | None:
    """Return the latest emergencies, the newest first; None without any."""
    if not any(row.emergencies for row in slaves):
        return None
    table = TextTable(
        "Slave",
        Column("Count", is_number=True),
        Column("Ago", is_number=True),
        Column("By", rank=1),
        "Emergency",
        Column("Meaning", wraps=True),
        Column("Register", rank=2),
        Column("Data", rank=3),
    )
    for row in slaves:
        first = (f"{row.address} {row.name}", str(row.emergencies))
        newest = row.latest_emergencies[::-1]
        for each in newest if is_full else newest[:_SHOWN_EMERGENCIES]:
            ago = "" if each.time is None else age(each.time, now_s)
            by = f"{each.protocol} drive {each.drive}" if each.drive else each.protocol
            code, register = f"0x{each.code:04X}", f"0x{each.register:02X}"
            table.add_row(*first, ago, by, code, each.text, register, each.data)
            first = ("", "")
    return table


def eoe_table(report: EoeReport) -> TextTable:
    """Return the ports of the Ethernet switch of a bus: the host, and the slaves with EoE."""
    table = TextTable(
        "EoE port",
        Column("Address", wraps=True),
        Column("In", is_number=True),
        Column("Out", is_number=True),
        Column("Dropped", is_number=True),
        Column("Invalid", rank=1, is_number=True),
        Column("Failed", rank=1, is_number=True),
    )
    host = "not open" if report.fault else report.address or "open"
    figures = (report.received, report.sent, report.dropped)
    table.add_row(report.interface, host, *map(str, figures), "", "")
    for row in report.slaves:
        address = row.ip or " ".join(row.addresses)
        numbers = (row.received, row.sent, row.dropped, row.invalid, row.failed)
        shown = address if row.is_connected else "no mailbox"
        table.add_row(f"{row.station} {row.name}", shown, *map(str, numbers))
    return table


def finding_line(row: FindingRow, now_s: float) -> str:
    """Return one finding as a line: the fault, since or until when, and the remedy."""
    if not row.is_over:
        since = "" if row.since is None else f"since {age(row.since, now_s)} ago: "
        return f"{since}{row.what}" + (f"; {row.advice}" if row.advice else "")
    until = "before the master started"
    if row.until is not None:
        until = f"until {age(row.until, now_s)} ago"
    return f"was, {until}: {row.what}; --reset clears this"


def _has_errors(slave: DiagnosedSlave) -> bool:
    return bool(slave.mailbox_timeouts) or any(
        port.invalid_frames or port.physical or port.forwarded or port.lost_links
        for port in slave.ports
    )


def _port_table(slaves: Sequence[DiagnosedSlave]) -> TextTable:
    # Two more columns only with content: the table has to fit on 80 columns.
    has_timeouts = any(row.mailbox_timeouts or row.mailbox_late for row in slaves)
    mailbox = (
        Column("Mailbox\ntimeouts", is_number=True),
        Column("Late\nreplies", rank=4, is_number=True),
    )
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
        *(mailbox if has_timeouts else ()),
    )
    for row in slaves:
        first = (str(row.address), row.name, _state(row.state if row.answers else None))
        if not row.ports:
            table.add_row(*first)
        counts = (str(row.mailbox_timeouts or ""), str(row.mailbox_late or ""))
        for port in row.ports:
            errors = (port.invalid_frames, port.physical, port.forwarded, port.lost_links)
            # A closed port without errors is the usual end of a line.
            if not port.is_open and not any(errors):
                continue
            numbers = (str(each or "") for each in errors)
            location = (*first, str(port.port), "yes" if port.is_open else "no")
            table.add_row(*location, *numbers, *(counts if has_timeouts else ()))
            first, counts = ("", "", Styled()), ("", "")
    return table


def eeprom_lines(content: EepromContent, *, has_octets: bool) -> Iterator[str]:
    """Yield the identity in an EEPROM and its categories, then its bytes if *has_octets*."""
    yield f"slave {content.address}: {content.name or 'no name'}"
    identity = {
        "vendor": content.vendor,
        "product": content.product,
        "revision": content.revision,
        "serial": content.serial,
    }
    for key, number in identity.items():
        yield f"  {key:9} 0x{number:08X}"
    intact = "correct" if content.intact else "WRONG"
    kinds = ", ".join(f"{each.type} ({each.octets})" for each in content.categories)
    yield f"  checksum {intact}; {content.octets} bytes"
    yield f"  categories (bytes) {kinds or 'none'}"
    image = bytes.fromhex(content.data) if has_octets else b""
    for offset in range(0, len(image), 16):
        yield f"{offset:04x}  {image[offset : offset + 16].hex(' ')}"


def value_line(found: SdoValue) -> str:
    """Return an entry and its value."""
    octets = bytes.fromhex(found.data)
    name = ObjectId(found.index, found.subindex)
    if found.value is None:
        return f"{name} = [{octets.hex(' ')}] ({count(len(octets), 'byte')})"
    kind = f" {found.type}" if found.type else ""
    return f"{name} ={kind} {_value(found.value, found.data)}"


def object_table(rows: Iterable[SlaveObject | OdObjectRow]) -> Iterator[TextTable]:
    """Yield the table of objects."""
    table = TextTable(
        "Index",
        Column("Name", wraps=True),
        Column("Kind", rank=1),
        Column("Subindexes", rank=2, is_number=True),
    )
    for row in rows:
        top = f"{row.max_subindex:X}" if row.max_subindex else ""
        table.add_row(f"0x{row.index:04X}", row.name, row.code, top)
    yield table


def dump_table(rows: Iterable[SdoDumpEntry]) -> Iterator[TextTable]:
    """Yield the table of all entries with their values."""
    table = TextTable(
        "Entry",
        Column("Name", wraps=True),
        Column("Type", rank=1),
        Column("Access", rank=2),
        Column("Value", wraps=True),
    )
    for row in rows:
        own, whole = row.name, row.object
        name = own if own == whole or not own else f"{whole}: {own}"
        table.add_row(
            str(ObjectId(row.index, row.subindex)),
            name or whole,
            row.type or "",
            row.access or "",
            dumped_value(row),
        )
    yield table


def dumped_value(row: SdoDumpEntry) -> Styled:
    """Return the value of an entry, or why there is none."""
    if row.error is not UNSET:
        return Styled(row.error, style="red")
    return Styled(_value(row.value, row.data) if isinstance(row.data, str) else "")


def idn_lines(found: IdnElements) -> Iterator[str]:
    """Yield an IDN and its elements."""
    unit = f" {found.unit}" if found.unit else ""
    yield f"{found.idn} = {_plain(found.value)}{unit}"
    state = found.data_state
    state_text = None
    if state is not None:
        word = f" ({_COMMAND_STATES.get(state, 'unknown')})" if found.is_command else ""
        state_text = f"0x{state:04X}{word}"
    shown = {
        "name": found.name,
        "minimum": found.minimum,
        "maximum": found.maximum,
        "default": found.default,
        "attribute": _attribute(found),
        "data state": state_text,
    }
    for key, value in shown.items():
        if value is not None:
            yield f"  {key:10} {_plain(value)}"


def idn_table(rows: Iterable[NamedIdn]) -> Iterator[TextTable]:
    """Yield the table of IDNs."""
    table = TextTable("IDN", Column("Name", wraps=True))
    for row in rows:
        table.add_row(row.idn, row.name)
    yield table


def _state(name: str | None) -> Styled:
    if name is None:
        return Styled("no answer", style="red")
    return Styled(name, style="red" if name.endswith("ERROR") else "")


def _reason(row: SlaveStateRow) -> str:
    return f"{row.reason} (0x{row.code:04X})" if row.code else row.reason


def _attribute(found: IdnElements) -> str:
    """Return the form of an IDN's value, and the states in which it cannot be written."""
    parts = [found.display.lower(), count(found.octets, "byte")]
    if found.is_list:
        parts[1] += " each, a list"
    if found.decimals:
        parts.append(count(found.decimals, "decimal"))
    if found.factor != 1:
        parts.append(f"factor {found.factor}")
    if found.is_command:
        parts.append("a procedure command")
    if found.protected_in:
        parts.append(f"read only in {', '.join(found.protected_in)}")
    return ", ".join(parts)


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return str(value)


def _value(value: Any, data: str) -> str:
    octets = bytes.fromhex(data)
    # A block's value is its digits again; the grouped form is easier to read.
    if value is None or value == data:
        more = f" … ({len(octets)} bytes)" if len(octets) > _SHOWN_OCTETS else ""
        return f"[{octets[:_SHOWN_OCTETS].hex(' ')}{more}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return f"{value} (0x{int.from_bytes(octets, 'little'):0{2 * len(octets)}X})"
    return str(value)
