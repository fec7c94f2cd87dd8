"""Reports of a master as text for a cell of a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby

from devicebus.master.bus import (
    BusBack,
    BusLost,
    Event,
    SlaveAbsent,
    SlaveBack,
    SlaveFailed,
    SlaveLeft,
    SlaveLost,
)
from devicebus.master.diagnosis import BusDiagnosis, SlaveDiagnosis
from devicebus.master.findings import SlaveView, find_causes, find_silence
from devicebus.master.mailboxes import Unsolicited
from devicebus.master.master import MasterStats
from devicebus.wire.alstatus import name_of, state_name
from eap.codec.coe import CoeHeader, CoeService, Emergency
from eap.codec.mailbox import MailboxType
from eap.codec.soe import SoeHeader, SoeOpcode

_MS = 1_000_000
Names = Mapping[int, str]


def after(duration_ns: int) -> str:
    """Write a duration in milliseconds, short ones with decimals."""
    decimals = 2 if duration_ns < _MS else 1 if duration_ns < 10 * _MS else 0
    return f"{duration_ns / _MS:.{decimals}f} ms"


def describe_events(events: Sequence[Event], names: Names, start_ns: int) -> list[str]:
    """Write events with the time since the fault began; equal ones are counted."""
    texts = [(_describe(event, names), _time_of(event)) for event in events]
    lines = []
    for text, group in groupby(texts, key=lambda entry: entry[0]):
        times = [at_ns for _, at_ns in group]
        when = "" if times[0] is None else f", {after(times[0] - start_ns)}"
        lines.append(f"{text}{when}" + (f" ({len(times)} times)" if len(times) > 1 else ""))
    return lines


def counters(before: MasterStats, now: MasterStats) -> str:
    """Write what was counted between two looks, without what stayed 0."""
    parts = []
    if before.cycle is not None and now.cycle is not None:
        parts += [
            (now.cycle.lost - before.cycle.lost, "cycles lost"),
            (now.cycle.wkc_errors - before.cycle.wkc_errors, "cycles with a wrong WKC"),
        ]
    parts += [
        (now.link.lost - before.link.lost, "frames lost"),
        (now.link.late - before.link.late, "frames late"),
        (now.link.retried - before.link.retried, "frames sent again"),
    ]
    for name, what in (("repeats", "repeat requests"), ("timeouts", "time-outs of mailboxes")):
        both = [sum(getattr(each, name) for each in s.mailboxes.values()) for s in (before, now)]
        parts.append((max(0, both[1] - both[0]), what))
    return ", ".join(f"{count} {what}" for count, what in parts if count)


def describe_diagnosis(found: BusDiagnosis, names: Names, ahead_ns: int | None) -> str:
    """Write what is not as it should be: one sentence for each cause, with what to do."""
    views = [_view(slave, names) for slave in found.slaves]
    causes = [find_silence(views)] if found.is_silent else find_causes(views, found)
    lines = [each.what + (f" ({each.advice})" if each.advice else "") for each in causes]
    if ahead_ns is not None:
        lines.append(f"the clock is {ahead_ns} ns ahead of the reference")
    return ". ".join(lines) or "nothing"


def _view(slave: SlaveDiagnosis, names: Names) -> SlaveView:
    trouble = ""
    if slave.answers and slave.state != "OP":
        code = f": {slave.text} (0x{slave.code:04X})" if slave.code else ""
        trouble = f"in {slave.state}{code}"
    return SlaveView(slave.station, names[slave.station], slave.answers, trouble)


def _time_of(event: Event) -> int | None:
    return None if isinstance(event, Unsolicited) else event.at_ns


def _describe(event: Event, names: Names) -> str:
    match event:
        case BusLost() | BusBack():
            return f"`{type(event).__name__}`"
        case SlaveLost() | SlaveAbsent():
            return f"`{type(event).__name__}` {names[event.station]}"
        case SlaveLeft():
            status = f"{state_name(event.status)}, 0x{event.code:04X} {name_of(event.code)}"
            return f"`SlaveLeft` {names[event.station]}: {status}"
        case SlaveBack():
            missed = f"missed for {after(event.duration_ns)}"
            return f"`SlaveBack` {names[event.station]}: {missed}"
        case SlaveFailed():
            return f"`SlaveFailed` {names[event.station]}: {event.reason}"
        case Unsolicited():
            return f"`Unsolicited` {names[event.station]}: {_message(event.type, event.data)}"


def _message(kind: MailboxType, data: bytes) -> str:
    if kind is MailboxType.COE:
        header = CoeHeader.decode(data)
        if header.service is CoeService.EMERGENCY:
            code = Emergency.decode(data, CoeHeader.SIZE).error_code
            return f"emergency 0x{code:04X} by CoE"
        return f"{header.service.name} {header.number} with {data[CoeHeader.SIZE :].hex(' ')}"
    if kind is MailboxType.SOE and SoeHeader.decode(data).opcode is SoeOpcode.EMERGENCY:
        code = Emergency.decode(data, SoeHeader.SIZE).error_code
        return f"emergency 0x{code:04X} by SoE"
    return f"{kind.name} {data.hex(' ')}"
