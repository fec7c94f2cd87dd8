"""Events of plants in words, from successive status reports.

A fault that appears among the findings is an event, and so is its end.  Losses, late PDs, drops
and lost bus exchanges are episodes: one event when the first is counted, and one with their number
when none was for some seconds.  States of stations and slaves and restarts of processes are
compared.  The first report of an appliance only begins: what was before is no event, except the
faults that it has now.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import msgspec

from eap.live.findings import Severity, StatusFinding, StatusReport, appliance_label, is_hung
from eap.live.rows import Row, StationKey, count_dropped, stations_of
from eap.live.status import ApplianceStatus
from eap.quantities import count, duration, times

MAX_EVENTS = 1000
"""Events that a log keeps."""
QUIET_NS = 5_000_000_000
"""An episode is over when nothing was counted for this long."""
_LISTED = 3
"""So many PDs or slaves are named in an event; of more, their number is given."""
_SAID_OTHERWISE = ("in PREOP", "in SAFEOP", "starting")
"""Findings that the change of a station's state or the restart of a process says already."""


class LiveEvent(msgspec.Struct, frozen=True):
    """Event in a plant.

    Attributes:
        time: Unix time at which it was noticed.
        severity: ``error``, ``warning`` or ``info``; the end of a fault is ``info``.
        plant: Name of the plant.
        where: Station, port, slave, PD or process.
        what: The event in words.
        advice: What to do, or empty.
    """

    time: float
    severity: Severity
    plant: str
    where: str
    what: str
    advice: str = ""

    @property
    def text(self) -> str:
        """The event as a sentence."""
        return "; ".join(filter(None, (f"{self.where}: {self.what}", self.advice)))


class EventLog:
    """Events of the reports that it gets, the latest last.

    Attributes:
        events: The latest ones.
    """

    def __init__(self, *, most: int = MAX_EVENTS) -> None:
        self.events: deque[LiveEvent] = deque(maxlen=most)
        # The last ones known: an appliance that does not answer for a moment is not new afterwards.
        self._appliances: dict[tuple[str, tuple[str, ...]], ApplianceStatus] = {}
        self._stations: dict[StationKey, Row] = {}
        self._faults: dict[_FaultKey, _Fault] = {}
        self._episodes: dict[_EpisodeKey, _Episode] = {}
        self._silent: dict[str, int] = {}

    def take(
        self,
        report: StatusReport,
        now_ns: int,
        now_s: float,
        unreachable: Mapping[str, str] = {},
    ) -> list[LiveEvent]:
        """Return the new events of a report, and keep them.

        Args:
            report: The report.
            now_ns: Its time on the monotonic clock.
            now_s: Its Unix time.
            unreachable: Appliances or hosts that do not answer, with the reason.
        """
        # Causes come last: a view that shows the latest events alone shows them.
        found = [
            *self._counts(report, now_ns),
            *self._states(report),
            *self._fault_changes(report, now_ns),
            *self._restarts(report),
            *self._reachability(unreachable, now_ns),
        ]
        self._appliances |= _appliances(report)
        self._stations |= stations_of(report)
        events = [LiveEvent(round(now_s, 3), *each) for each in found]
        self.events.extend(events)
        return events

    def _reachability(self, unreachable: Mapping[str, str], now_ns: int) -> Iterator[_Found]:
        for name, why in unreachable.items():
            if name not in self._silent:
                self._silent[name] = now_ns
                yield _Found(Severity.ERROR, name, name, why)
        for name in [each for each in self._silent if each not in unreachable]:
            lasted = _lasted(now_ns - self._silent.pop(name))
            yield _Found(Severity.INFO, name, name, f"answers again after {lasted}")

    def _restarts(self, report: StatusReport) -> Iterator[_Found]:
        for key, appliance in _appliances(report).items():
            if (earlier := self._appliances.get(key)) is None:
                continue
            label = appliance_label(report, appliance)
            if appliance.processes["supervisor"]["pid"] != earlier.processes["supervisor"]["pid"]:
                what = "the appliance was started again"
                yield _Found(Severity.WARNING, appliance.plant, label, what)
                continue
            old = _processes(earlier)
            for name, process in _processes(appliance).items():
                ended = (process.get("restarts") or 0) - (old.get(name, {}).get("restarts") or 0)
                if ended > 0:
                    total = times(process["restarts"])
                    what = f"ended and was restarted ({total} since the start)"
                    advice = f"see the log of 'eapctl run' for {name}"
                    yield _Found(Severity.ERROR, appliance.plant, f"{label} {name}", what, advice)

    def _states(self, report: StatusReport) -> Iterator[_Found]:
        for key, station in stations_of(report).items():
            if (earlier := self._stations.get(key)) is None:
                continue
            plant, name = key
            if station["state"] != earlier["state"]:
                severity = Severity.INFO if station["state"] == "OP" else Severity.WARNING
                what = f"state {earlier['state']} → {station['state']}"
                yield _Found(severity, plant, name, what)
            slaves = _slaves(earlier)
            changed: dict[tuple[str, str, str], list[str]] = {}
            for (port, slave), state in _slaves(station).items():
                # A slave that is new to the log has no state before.
                if (old := slaves.get((port, slave), state)) != state:
                    changed.setdefault((port, old, state), []).append(slave)
            for (port, old, state), names in changed.items():
                severity = Severity.INFO if state == "OP" else Severity.WARNING
                what = f"{_listed(names, 'slave')}: {old} → {state}"
                yield _Found(severity, plant, f"{name}/{port}", what)

    def _fault_changes(self, report: StatusReport, now_ns: int) -> Iterator[_Found]:
        present = [
            each
            for each in report.findings
            if each.severity is not Severity.INFO and not each.what.startswith(_SAID_OTHERWISE)
        ]
        before, self._faults = self._faults, {}
        rest: list[StatusFinding] = []
        for each in present:
            key = _FaultKey(each.plant, each.where, each.what)
            if (known := before.pop(key, None)) is not None:
                self._faults[key] = known
            else:
                rest.append(each)
        # A fault whose text has a number that grows is the same one.
        similar: dict[_FaultKey, list[_FaultKey]] = {}
        for key in before:
            similar.setdefault(_without_numbers(key), []).append(key)
        for each in rest:
            key = _FaultKey(each.plant, each.where, each.what)
            if old := similar.get(_without_numbers(key)):
                self._faults[key] = before.pop(old.pop(0))
            else:
                self._faults[key] = _Fault(each, now_ns)
                yield _Found(each.severity, each.plant, each.where, each.what, each.advice)
        answering = {each.plant for each in report.appliances}
        for key, fault in before.items():
            if key.plant not in answering:  # nothing is known about it now
                self._faults[key] = fault
                continue
            first = key.what.partition("; ")[0]
            what = f"over after {_lasted(now_ns - fault.began_ns)}: {first}"
            yield _Found(Severity.INFO, key.plant, key.where, what)

    def _counts(self, report: StatusReport, now_ns: int) -> Iterator[_Found]:
        for key, station in stations_of(report).items():
            earlier = self._stations.get(key)
            if earlier is not None:
                for kind in _KINDS:
                    yield from self._count(kind, key, station, earlier, now_ns)
        for at, episode in list(self._episodes.items()):
            if now_ns - episode.last_ns < QUIET_NS:
                continue
            del self._episodes[at]
            lasted = episode.last_ns - episode.began_ns
            # A single burst was said as a whole when it began.
            if lasted:
                what = f"{at.kind.text(episode.total)} in {_lasted(lasted)}, none since"
                yield _Found(Severity.INFO, at.plant, at.where, what)

    def _count(
        self, kind: _Kind, key: StationKey, station: Row, earlier: Row, now_ns: int
    ) -> Iterator[_Found]:
        """Follow one kind of counters of a station; those of a group begin and end together."""
        for group, (old, new) in _grouped(kind.counters, station, earlier).items():
            grown = {name: number - old[name] for name, number in new.items() if number > old[name]}
            if not grown:
                continue
            where = f"{key[1]}{group}"
            at = _EpisodeKey(kind, key[0], where)
            total = sum(grown.values())
            if (episode := self._episodes.get(at)) is not None:
                episode.total += total
                episode.last_ns = now_ns
                continue
            self._episodes[at] = _Episode(now_ns, total)
            what = kind.text(total)
            if names := [name for name in grown if name]:
                what += f": {_listed(names, kind.noun)}"
            yield _Found(Severity.WARNING, key[0], where, what)


class _Found(NamedTuple):
    severity: Severity
    plant: str
    where: str
    what: str
    advice: str = ""


class _FaultKey(NamedTuple):
    plant: str
    where: str
    what: str


class _Fault(NamedTuple):
    finding: StatusFinding
    began_ns: int


_Counters: TypeAlias = Callable[[Row], Iterable[tuple[str, str, int]]]
"""Of a station: group, name in the group, and count."""


class _Kind(NamedTuple):
    """One kind of counters: their source, and an event of a number of them."""

    noun: str
    counters: _Counters
    words: str

    def text(self, number: int) -> str:
        return self.words.format(number=number)


class _EpisodeKey(NamedTuple):
    kind: _Kind
    plant: str
    where: str


class _Episode:
    def __init__(self, began_ns: int, total: int) -> None:
        self.began_ns = began_ns
        self.last_ns = began_ns
        self.total = total


def _received(key: str) -> _Counters:
    def counters(station: Row) -> Iterator[tuple[str, str, int]]:
        for row in station["pd"]["rx"]:
            yield "", row["name"], row[key] or 0

    return counters


def _dropped(station: Row) -> Iterator[tuple[str, str, int]]:
    # Frames that are of no PD count for their station.
    yield "", "", count_dropped(station)
    for row in station["pd"]["rx"]:
        yield "", row["name"], count_dropped(row)


def _of_bus(key: str) -> _Counters:
    def counters(station: Row) -> Iterator[tuple[str, str, int]]:
        for port in station["ports"]:
            if (bus := port.get("bus")) is not None and not is_hung(station):
                yield f"/{port['name']}", "", bus[key]

    return counters


_KINDS = (
    _Kind("PD", _received("lost"), "{number} lost"),
    _Kind("PD", _received("late"), "{number} late"),
    _Kind("PD", _dropped, "{number} dropped"),
    _Kind("", _of_bus("lost"), "{number} exchanges of process data lost"),
    _Kind("", _of_bus("wkc_errors"), "{number} exchanges with a wrong working counter"),
)


def _grouped(
    counters: _Counters, station: Row, earlier: Row
) -> dict[str, tuple[Counter[str], Counter[str]]]:
    """Return the counts before and now of each group; new names begin at their present count."""
    groups: dict[str, tuple[Counter[str], Counter[str]]] = {}
    for group, name, number in counters(station):
        old, new = groups.setdefault(group, (Counter(), Counter()))
        old[name] = new[name] = number
    for group, name, number in counters(earlier):
        if group in groups and name in groups[group][1]:
            groups[group][0][name] = number
    return groups


def _appliances(report: StatusReport) -> dict[tuple[str, tuple[str, ...]], ApplianceStatus]:
    return {(each.plant, tuple(each.stations)): each for each in report.appliances}


def _processes(appliance: ApplianceStatus) -> dict[str, Mapping[str, Any]]:
    processes = dict(appliance.processes)
    segments = processes.pop("segments", {})
    return processes | {f"segment {name}": process for name, process in segments.items()}


def _slaves(station: Row) -> dict[tuple[str, str], str]:
    """Return the state of each slave of the buses that are up, by port and name."""
    return {
        (port["name"], slave["name"]): slave["state"] or "no answer"
        for port in station["ports"]
        if (bus := port.get("bus")) is not None and bus["is_up"]
        for slave in bus["slaves"]
    }


def _listed(names: Sequence[str], noun: str) -> str:
    if len(names) <= _LISTED:
        return ", ".join(names)
    return f"{names[0]} and {count(len(names) - 1, f'other {noun}')}"


def _without_numbers(key: _FaultKey) -> _FaultKey:
    return _FaultKey(key.plant, *(re.sub(r"[0-9.]+ ?(µs|ms|s|min|h)?\b", "#", t) for t in key[1:]))


def _lasted(ns: int) -> str:
    return duration(ns // 1000)
