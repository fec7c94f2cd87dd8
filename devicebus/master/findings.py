"""Findings about a bus: one for each cause, for any number of slaves.

A cut cable silences all slaves behind it, and a lost frame gives no information about any slave.  A
finding therefore names the first slave concerned and the nearest slaves that answer.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from types import MappingProxyType
from typing import NamedTuple

import msgspec

from devicebus.errors import BusError, FrameLostError
from devicebus.master.diagnosis import BusDiagnosis, Fault, PortErrors
from eap.errors import EapError

NO_ANSWER = "it does not answer"
# Error counters are read each second.
SAME_TIME_NS = 2_000_000_000
"""Faults that ended within this time have one cause."""
RECENT_NS = 2_500_000_000
"""Errors of a port counted within this time are still going on."""
# Limit for naming slaves one by one.
_LISTED = 3
_SLAVE = re.compile(r"^slave \d+(?: \([^)]*\))?:? ")
_NO_FRAME = "no frame came back"
UNANSWERED_NS = 60_000_000_000
"""A mailbox request without a reply is a present fault for so long."""


class SlaveView(NamedTuple):
    """Slave with its present fault, for findings."""

    station: int
    name: str
    answers: bool = True
    trouble: str = ""
    """Reason that it is not in its target state; empty if it is."""
    since_ns: int | None = None
    """Age of the fault in ns, if known."""

    def __str__(self) -> str:
        return f"{self.name} ({self.station})"


class MailboxTimeouts(NamedTuple):
    """Mailbox requests to a slave without a reply."""

    slave: SlaveView
    number: int
    late: int
    """Replies that came after their request had timed out."""
    last_ns: int
    """Age of the last time-out."""


class FaultPeriod(NamedTuple):
    """Ages of the start and the end of a fault in ns."""

    since_ns: int
    until_ns: int


class BusFinding(msgspec.Struct, frozen=True, kw_only=True):
    """One cause of faults, with advice."""

    what: str
    advice: str = ""
    slaves: tuple[int, ...] = ()
    """Station addresses of the slaves concerned, in the order of the segment."""
    port: int | None = None
    """Port at which errors start, or whose link was lost."""
    is_over: bool = False
    since_ns: int | None = None
    """Age of its start in ns, if known."""
    until_ns: int | None = None
    """Age of its end in ns, if it has ended and this is known."""


class RingCut(NamedTuple):
    """Last cut of a ring with a second line to the master."""

    ends: tuple[int | None, int | None] | None
    """Stations before and behind the cut, None in it for the master; None if not known."""
    since_ns: int
    """Age of the cut in ns."""
    until_ns: int | None = None
    """Age of its mending in ns."""


class History(NamedTuple):
    """Past faults of the slaves as a running master noted them."""

    over: tuple[tuple[SlaveView, FaultPeriod], ...] = ()
    """Slaves with their past fault, in the order of the segment."""
    silence: FaultPeriod | None = None
    """Last period without frames, if it has ended."""
    silent_since_ns: int | None = None
    """Age of the present period without frames in ns, if there is one."""
    ports: Mapping[tuple[int, int], FaultPeriod] = MappingProxyType({})
    """Periods in which errors were counted, by station address and port."""
    mailboxes: tuple[MailboxTimeouts, ...] = ()
    """Slaves with mailbox requests without a reply."""
    ring: RingCut | None = None


def find_causes(
    slaves: Sequence[SlaveView],
    diagnosis: BusDiagnosis | None = None,
    history: History | None = None,
) -> list[BusFinding]:
    """Return present findings, then past ones, of a bus whose frames come back.

    Args:
        slaves: All slaves in the order of the segment.
        diagnosis: Their AL status and counters, if read.
        history: Past faults; without it counted errors are reported as present.
    """
    faults = list(diagnosis.faults) if diagnosis is not None else []
    found = []
    ring = history.ring if history is not None else None
    cut = find_ring_cut(slaves, ring)
    if cut and diagnosis is not None:  # the links that it took have the same cause
        faults = [each for each in faults if not _is_of_cut(each, diagnosis, cut[0])]
    found += [each for each in cut if not each.is_over]
    for first, count in _silent_runs(slaves):
        before = slaves[first - 1].station if first else None
        there = next((each for each in faults if each.station == before), None)
        found.append(_no_answer(slaves, first, count, there.port if there else None))
        if there is not None:  # the lost link of that port has the same cause
            faults.remove(there)
    for trouble, group in _by_trouble([each for each in slaves if each.answers]):
        found.append(
            BusFinding(
                what=_describe(group, trouble), slaves=_stations(group), since_ns=_since_ns(group)
            )
        )
    if diagnosis is not None:
        found += _port_findings(slaves, diagnosis, faults, history)
    past = _past(slaves, history) if history is not None else []
    past += [each for each in cut if each.is_over]
    missed = find_unanswered(history.mailboxes) if history is not None else []
    present = [each for each in (*found, *missed) if not each.is_over]
    return [*present, *_merged(past, found), *(each for each in missed if each.is_over)]


def find_ring_cut(slaves: Sequence[SlaveView], ring: RingCut | None) -> list[BusFinding]:
    """Return the finding about the last cut of a ring, present or past; none without a cut."""
    if ring is None:
        return []
    ends = "at an unknown place"
    beside: tuple[int, ...] = ()
    if ring.ends is not None:
        names = {each.station: str(each) for each in slaves}
        beside = tuple(each for each in ring.ends if each in names)
        first, second = (names.get(each or 0, "") for each in ring.ends)
        first = first or "the first line of the master"
        ends = f"between {first} and {second or 'the second line of the master'}"
    is_over = ring.until_ns is not None
    return [
        BusFinding(
            what=f"the ring {'was' if is_over else 'is'} cut {ends}",
            advice="" if is_over else "mend the cable: a second cut would lose slaves",
            slaves=beside,
            is_over=is_over,
            since_ns=ring.since_ns,
            until_ns=ring.until_ns,
        )
    ]


def _is_of_cut(fault: Fault, diagnosis: BusDiagnosis, cut: BusFinding) -> bool:
    """Return true if a port has counted nothing but the link that it lost by the cut."""
    if fault.station not in cut.slaves:
        return False
    slave = next(each for each in diagnosis.slaves if each.station == fault.station)
    return any(
        port.port == fault.port and port.total == port.lost_links and port.is_open == cut.is_over
        for port in slave.ports
    )


def find_unanswered(mailboxes: Sequence[MailboxTimeouts]) -> list[BusFinding]:
    """Return findings about mailbox requests without a reply: present ones, then past ones.

    A finding is present for UNANSWERED_NS after the last time-out.
    """
    found = []
    for is_over in (False, True):
        group = [each for each in mailboxes if (each.last_ns > UNANSWERED_NS) == is_over]
        # One finding for many slaves: their number must not hide other faults.
        parts = [group] if len(group) > _LISTED else [[each] for each in group]
        found += [_unanswered(part, is_over=is_over) for part in parts if part]
    return found


def _unanswered(group: Sequence[MailboxTimeouts], *, is_over: bool) -> BusFinding:
    number, late = sum(each.number for each in group), sum(each.late for each in group)
    last_ns = min(each.last_ns for each in group)
    slaves = [each.slave for each in group]
    what = f"{_listed([str(each) for each in slaves])}: "
    what += f"{number} mailbox request{'s' * (number != 1)} without reply in time"
    if late:
        what += f", {late} late repl{'ies' if late > 1 else 'y'}"
    if not is_over:
        what += f", last {last_ns // 1_000_000_000} s ago"
    return BusFinding(
        what=what,
        advice="" if is_over else "check the application of the slave",
        slaves=_stations(slaves),
        is_over=is_over,
        until_ns=last_ns,
    )


def find_silence(slaves: Sequence[SlaveView], since_ns: int | None = None) -> BusFinding:
    """Return the finding that no frame comes back, so that no slave can be blamed."""
    if not slaves:
        return BusFinding(what="no frame comes back", advice="check the interface and the cable")
    return BusFinding(
        what=f"no frame comes back: {_count(len(slaves))} cannot be reached",
        advice=f"check the interface, the cable to {slaves[0]} and its power",
        slaves=_stations(slaves),
        since_ns=since_ns,
    )


def _port_findings(
    slaves: Sequence[SlaveView],
    diagnosis: BusDiagnosis,
    faults: Sequence[Fault],
    history: History | None,
) -> Iterator[BusFinding]:
    """Yield the first port with new errors, and the first port of each past period."""
    ports = history.ports if history is not None else {}
    timed = [(fault, ports.get((fault.station, fault.port))) for fault in faults]
    if history is not None:
        timed.sort(key=lambda each: _is_over(each[1]))
    moments: list[int | None] = []
    cables: set[frozenset[int]] = set()
    for fault, times in timed:
        is_over = history is not None and _is_over(times)
        moment = times.until_ns if times is not None and is_over else None if is_over else 0
        # Both ends of a cable count its errors: only the first end is named.
        cable = frozenset((fault.station, fault.neighbour or 0))
        if cable in cables or any(_same_time(moment, each) for each in moments):
            continue
        moments.append(moment)
        cables.add(cable)
        finding = _errors(slaves, diagnosis, fault, "started" if is_over else "start")
        yield msgspec.structs.replace(
            finding,
            is_over=is_over,
            since_ns=times.since_ns if times is not None else None,
            until_ns=times.until_ns if times is not None and is_over else None,
        )


def _is_over(times: FaultPeriod | None) -> bool:
    return times is None or times.until_ns > RECENT_NS


def _past(slaves: Sequence[SlaveView], history: History) -> list[BusFinding]:
    """Return past findings; faults that ended at one time are one finding."""
    groups: list[list[tuple[SlaveView, FaultPeriod]]] = []
    silence = history.silence
    for slave, times in history.over:
        if silence is not None and any(_same_time(times.since_ns, each) for each in silence):
            continue  # the silence is the cause, directly or by the slave's watchdog
        for group in groups:
            same = _same_time(group[0][1].until_ns, times.until_ns)
            if group[0][0].trouble == slave.trouble and same:
                group.append((slave, times))
                break
        else:
            groups.append([(slave, times)])
    found = []
    if silence is not None:
        what = f"no frame came back, so that {_count(len(slaves))} could not be reached"
        found.append(
            BusFinding(what=what, slaves=_stations(slaves), is_over=True, **silence._asdict())
        )
    return found + [
        BusFinding(
            what=_describe_past([slave for slave, _ in group], group[0][0].trouble),
            slaves=_stations([slave for slave, _ in group]),
            is_over=True,
            since_ns=max(times.since_ns for _, times in group),
            until_ns=min(times.until_ns for _, times in group),
        )
        for group in groups
    ]


def _merged(past: Sequence[BusFinding], found: Sequence[BusFinding]) -> Iterator[BusFinding]:
    """Yield past findings; port errors that began with a fault of slaves are merged into it."""
    ports = [each for each in found if each.is_over]
    for each in past:
        there = [port for port in ports if _belongs(port, each)]
        ports = [port for port in ports if port not in there]
        if not there:
            yield each
            continue
        first = there[0]
        yield msgspec.structs.replace(
            each, what=f"{each.what}; {first.what}", advice=first.advice, port=first.port
        )
    yield from ports


def _belongs(port: BusFinding, trouble: BusFinding) -> bool:
    """Return true if port errors came with a fault of slaves, or with its end at one of them."""
    return _same_time(port.since_ns, trouble.since_ns) or (
        port.slaves[0] in trouble.slaves and _same_time(port.since_ns, trouble.until_ns)
    )


def _same_time(one_ns: int | None, other_ns: int | None) -> bool:
    if one_ns is None or other_ns is None:
        return one_ns is other_ns
    return abs(one_ns - other_ns) < SAME_TIME_NS


def join_errors(errors: Sequence[tuple[str, EapError]]) -> EapError:
    """Join the errors of several slaves into one error, with one line for each cause.

    Args:
        errors: Names of slaves with their errors; at least one.
    """
    if len(errors) == 1:
        return errors[0][1]
    causes: dict[str, list[str]] = {}
    for name, error in errors:
        causes.setdefault(_cause(error), []).append(name)
    if list(causes) == [_NO_FRAME]:
        return FrameLostError(
            f"frames to {_listed([name for name, _ in errors])} did not come back: they are lost"
            " on a cable, or this machine is too busy; it is tried again"
        )
    lines = [f"{_listed(names)}: {cause}" for cause, names in causes.items()]
    if len(lines) == 1:
        return BusError(lines[0])
    return BusError(f"{_count(len(errors))} have failed:\n  " + "\n  ".join(lines))


def describe_trouble(names: Sequence[str], trouble: str) -> str:
    """Return the text of a fault that the slaves of these *names* share."""
    text = without_slave(trouble)
    colon = "" if len(names) == 1 and text.startswith("it ") else ":"
    return f"{_listed(names)}{colon} {text.removeprefix('it ')}"


def without_slave(text: str) -> str:
    """Return the text of a fault without the slave at its start."""
    return _SLAVE.sub("", text)


def describe_counters(port: PortErrors) -> str:
    """Return the error counters of a port that are not 0, in words."""
    kinds = (
        (port.invalid_frames, "invalid frame"),
        (port.physical, "physical error"),
        (port.forwarded, "forwarded error"),
        (port.lost_links, "lost link"),
    )
    return ", ".join(f"{n} {what}{'s' * (n != 1)}" for n, what in kinds if n)


def _cause(error: EapError) -> str:
    """Return the text of an error without its slave."""
    return _NO_FRAME if isinstance(error, FrameLostError) else without_slave(str(error))


def _silent_runs(slaves: Sequence[SlaveView]) -> list[tuple[int, int]]:
    """Return position and length of each run of slaves that do not answer."""
    runs = []
    for answers, run in groupby(enumerate(slaves), key=lambda each: each[1].answers):
        positions = [position for position, _ in run]
        if not answers:
            runs.append((positions[0], len(positions)))
    return runs


def _no_answer(slaves: Sequence[SlaveView], first: int, count: int, port: int | None) -> BusFinding:
    """Return the finding about *count* slaves from position *first* on that do not answer.

    Args:
        slaves: All of the line.
        first: Position of the first silent one.
        count: How many do not answer.
        port: Port of the slave before that has lost its link, if one has.
    """
    silent = slaves[first]
    run = slaves[first : first + count]
    if count == len(slaves) > 1:
        return BusFinding(
            what=f"none of the {count} slaves answers, although frames come back",
            advice="look whether these are other slaves, or were switched off and on together",
            slaves=_stations(run),
            since_ns=_since_ns(run),
        )
    text = f"{silent} does not answer"
    if count > 1:
        text = f"{silent} and {_count(count - 1)} behind it do not answer"
    parts = [text]
    if first:
        lost = "" if port is None else f", whose port {port} has lost its link"
        parts.append(f"the last that answers before it is {slaves[first - 1]}{lost}")
    if first + count < len(slaves):
        parts.append(f"{slaves[first + count]} behind answers")
    return BusFinding(
        what="; ".join(parts),
        advice=f"check the cable to {silent} and its power",
        slaves=_stations(run),
        port=port,
        since_ns=_since_ns(run),
    )


def _errors(
    slaves: Sequence[SlaveView], diagnosis: BusDiagnosis, fault: Fault, verb: str
) -> BusFinding:
    """Return the finding about the first port with errors."""
    names = {each.station: str(each) for each in slaves}
    port = next(
        port
        for slave in diagnosis.slaves
        if slave.station == fault.station
        for port in slave.ports
        if port.port == fault.port
    )
    cable_end = f" to {names[fault.neighbour]}" if fault.neighbour is not None else ""
    location = f"port {fault.port} of {names[fault.station]}"
    return BusFinding(
        what=f"errors {verb} at {location}: {describe_counters(port)}",
        advice=f"check its cable{cable_end} first",
        slaves=(fault.station,),
        port=fault.port,
    )


def _by_trouble(slaves: Sequence[SlaveView]) -> list[tuple[str, list[SlaveView]]]:
    groups: dict[str, list[SlaveView]] = {}
    for each in slaves:
        if each.trouble:
            groups.setdefault(each.trouble, []).append(each)
    return list(groups.items())


def _describe(slaves: Sequence[SlaveView], trouble: str) -> str:
    return describe_trouble([str(each) for each in slaves], trouble)


def _describe_past(slaves: Sequence[SlaveView], trouble: str) -> str:
    """Return the text of a past fault."""
    if trouble == NO_ANSWER:
        return f"{_listed([str(each) for each in slaves])} did not answer"
    return _describe(slaves, trouble)


def _listed(names: Sequence[str]) -> str:
    if len(names) > _LISTED:
        return f"{_count(len(names))} from {names[0]} to {names[-1]}"
    return ", ".join(names)


def _stations(slaves: Iterable[SlaveView]) -> tuple[int, ...]:
    return tuple(each.station for each in slaves)


def _since_ns(slaves: Iterable[SlaveView]) -> int | None:
    return max((each.since_ns for each in slaves if each.since_ns is not None), default=None)


def _count(number: int) -> str:
    return f"{number} slave{'s' * (number != 1)}"
