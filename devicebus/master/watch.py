"""Watching the slaves: one that goes is left out, one that comes back is brought back.

The others notice nothing: every step is an acyclic access within the budget of the cycle.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from devicebus.errors import FrameLostError, IdentityError, WorkingCounterError
from devicebus.master.bring import bring, set_clocks
from devicebus.master.bus import (
    Bus,
    BusBack,
    BusLost,
    SlaveBack,
    SlaveFailed,
    SlaveLeft,
    SlaveLost,
    Unit,
)
from devicebus.master.cycle import Presence
from devicebus.master.diagnosis import COUNTERS, port_counters
from devicebus.master.mailboxport import STATUS
from devicebus.master.procedure import Procedure, Sleep, Task
from devicebus.master.scan import assign_stations, count_slaves, read_identity, read_stations
from devicebus.wire.alstatus import ERROR, AlState
from devicebus.wire.datagram import DatagramReply, fprd, fpwr
from devicebus.wire.register import AlStatus, Register, SmStatus
from eap.errors import EapError

_PER_STEP = 15
"""As many as share one frame."""


def look_around(bus: Bus) -> Procedure[None]:
    """Have the mailboxes read that are full and that nobody is busy with."""
    idle = [unit.mailbox for unit in bus.units.values() if unit.mailbox is not None]
    idle = [mailbox for mailbox in idle if not mailbox.is_busy]
    for start in range(0, len(idle), _PER_STEP):
        part = idle[start : start + _PER_STEP]
        try:
            replies, now_ns = yield [fprd(each.station, STATUS, 1, tries=1) for each in part]
        except FrameLostError:
            continue  # the next look comes soon
        for mailbox, reply in zip(part, replies, strict=True):
            if reply.wkc and reply.data[0] & SmStatus.MAILBOX_FULL:
                mailbox.look(now_ns)


ERRORS_PERIOD_NS = 1_000_000_000


class Growth(NamedTuple):
    """First and last time at which more errors were seen at a port."""

    since_ns: int
    until_ns: int


class PortErrorLog:
    """When the counters of each port have grown, by station address and port."""

    def __init__(self) -> None:
        self._counters: dict[int, tuple[int, ...]] = {}
        self._growth: dict[int, dict[int, Growth]] = {}

    def of(self, station: int) -> dict[int, Growth]:
        """Return by port when errors were seen; a port that was quiet is not there."""
        return self._growth.get(station, {})

    def clear(self) -> None:
        """Forget all times; what the counters show now is not new."""
        self._growth.clear()

    def take(self, station: int, octets: bytes, now_ns: int) -> None:
        """Take the counters of a slave as they are now.

        What they show at the first look has happened at an unknown time.  Counters that are smaller
        than before were cleared, or the slave was switched off: older times go with them.
        """
        counters = port_counters(octets)
        before = self._counters.get(station, counters)
        self._counters[station] = counters
        if any(now < old for now, old in zip(counters, before, strict=True)):
            self._growth.pop(station, None)
            before = (0,) * len(counters)
        for port, (now, old) in enumerate(zip(counters, before, strict=True)):
            if now > old:
                ports = self._growth.setdefault(station, {})
                first = ports[port].since_ns if port in ports else now_ns
                ports[port] = Growth(first, now_ns)


def look_at_errors(bus: Bus, log: PortErrorLog) -> Procedure[None]:
    """Read the error counters of all slaves that answer."""
    stations = [unit.station for unit in bus.units.values() if not unit.is_lost]
    for start in range(0, len(stations), _PER_STEP):
        part = stations[start : start + _PER_STEP]
        try:
            replies, now_ns = yield [fprd(at, Register.RX_ERROR, COUNTERS, tries=1) for at in part]
        except FrameLostError:
            return  # the next look comes soon
        for station, reply in zip(part, replies, strict=True):
            if reply.wkc:
                log.take(station, reply.data, now_ns)


PERIOD_NS = 100_000_000
"""Between two looks at all slaves while nothing is wrong."""
SLICE_NS = 5_000_000
"""After trouble in the cycle the next look comes this soon."""
RETRY_NS = 1_000_000_000
"""Before a slave that could not be brought back is tried again."""
_STATES_PER_STEP = 60
"""Slaves whose states are read together."""
_WITH_PROCESS_DATA = frozenset((AlState.SAFEOP, AlState.OP))
_STATES = {int(state): state for state in AlState}


def watch(bus: Bus) -> Procedure[None]:
    """Look at the slaves for ever."""
    while True:
        now_ns = yield from _pause(bus)
        try:
            count = yield from count_slaves()
            replies = yield from _read_states(list(bus.units))
        except FrameLostError:
            if not bus.is_lost:
                bus.is_lost = True
                for unit in bus.units.values():
                    unit.state = None
                bus.emit(BusLost(now_ns))
            continue
        if bus.is_lost:
            bus.is_lost = False
            bus.emit(BusBack(now_ns))
        for unit, reply in zip(list(bus.units.values()), replies, strict=True):
            if reply.wkc:
                _judge(bus, unit, AlStatus.decode(reply.data), now_ns)
            else:
                _lose(bus, unit, now_ns)
        lost = [unit for unit in bus.units.values() if unit.is_lost]
        if lost and count > len(bus.units) - len(lost):
            yield from _seek(bus, count, now_ns)


def _pause(bus: Bus) -> Procedure[int]:
    """Wait for the next look; return the time."""
    _, now_ns = yield Sleep(SLICE_NS)
    end_ns = now_ns + PERIOD_NS - SLICE_NS
    while now_ns < end_ns and not bus.is_troubled:
        _, now_ns = yield Sleep(SLICE_NS)
    bus.is_troubled = False
    return now_ns


def _read_states(stations: Sequence[int]) -> Procedure[list[DatagramReply]]:
    replies: list[DatagramReply] = []
    for start in range(0, len(stations), _STATES_PER_STEP):
        part = stations[start : start + _STATES_PER_STEP]
        answers, _ = yield [fprd(at, Register.AL_STATUS, AlStatus.SIZE) for at in part]
        replies += answers
    return replies


def _lose(bus: Bus, unit: Unit, now_ns: int) -> None:
    """A slave does not answer although the frame came back: leave it out."""
    if unit.is_lost:
        return
    unit.lose()
    unit.retry_ns = 0
    unit.missed_ns = unit.missed_ns or now_ns
    work, unit.work = unit.work, None
    if work is not None:
        work.cancel()
    bus.close_mailbox(unit)
    bus.set_presence(unit, Presence.UNSURE)
    if unit.station == bus.reference:
        bus.follow(None)  # without it the others would be handed the empty datagram's time
    bus.emit(SlaveLost(unit.station, now_ns))


def _judge(bus: Bus, unit: Unit, status: AlStatus, now_ns: int) -> None:
    """A slave answers: bring it back if it is not where it belongs."""
    if unit.is_busy:
        return
    if not unit.is_lost:  # of one that was, the identity is compared before its state counts
        unit.state = _STATES.get(status.state)
    if now_ns < unit.retry_ns:
        return
    is_set_up = unit.is_set_up or unit.target not in _WITH_PROCESS_DATA
    if status.state == unit.target and not status.error and is_set_up and not unit.is_lost:
        _take_back(bus, unit, now_ns)
        return
    if unit.missed_ns is None:
        unit.missed_ns = now_ns
        shown = status.state | (ERROR if status.error else 0)
        bus.emit(SlaveLeft(unit.station, shown, status.code, now_ns))
    _begin(bus, unit, status, now_ns)


def _take_back(bus: Bus, unit: Unit, now_ns: int) -> None:
    """A slave is where it belongs: report it if it was missed."""
    missed_ns, unit.missed_ns = unit.missed_ns, None
    if missed_ns is not None:
        bus.emit(SlaveBack(unit.station, now_ns - missed_ns, now_ns))


def _begin(bus: Bus, unit: Unit, status: AlStatus, now_ns: int) -> None:
    stays = (
        not unit.is_lost
        and status.state in _WITH_PROCESS_DATA
        and unit.target in _WITH_PROCESS_DATA
        and unit.is_set_up
    )
    bus.is_troubled = True

    def done(task: Task[int]) -> None:
        error = task.error
        if unit.work is not task or isinstance(error, FrameLostError):
            return  # the slave is lost meanwhile, or nobody knows: the next look begins again
        if error is None:
            _take_back(bus, unit, task.result())
        elif not (unit.is_lost and isinstance(error, WorkingCounterError)):
            unit.retry_ns = now_ns + RETRY_NS
            if isinstance(error, IdentityError):
                unit.lose()
                bus.close_mailbox(unit)
            bus.emit(SlaveFailed(unit.station, str(error), now_ns))

    work = _revive(bus, unit, stays=stays)
    task = bus.runner.start(work, now_ns, f"bringing back slave {unit.station}")
    unit.begin(task)
    task.watch(done)


def _revive(bus: Bus, unit: Unit, *, stays: bool) -> Procedure[int]:
    """Bring a slave back; return the time.  Unless it *stays* set up it begins in INIT."""
    if not stays:
        found = unit.found.identity
        identity = yield from read_identity(unit.station)
        if identity != found:
            yield [fpwr(unit.station, Register.STATION_ADDRESS, bytes(2))]
            raise IdentityError(
                f"in place of {unit.name} (station {unit.station}) there is {identity}, serial"
                f" {identity.serial}, expected {found}, serial {found.serial}"
            )
        yield from bring(bus, unit, AlState.INIT)
        unit.is_lost = False
        if bus.settings.clocks:
            yield from set_clocks(bus, only=frozenset((unit.station,)))
    yield from bring(bus, unit, unit.target)
    _, now_ns = yield Sleep(0)
    return now_ns


def _seek(bus: Bus, count: int, now_ns: int) -> Procedure[None]:
    """Give slaves that came without an address that of the lost one whose place they have."""
    try:
        stations = yield from read_stations(count)
        places = _places(bus, stations, now_ns)
        if places:
            yield from assign_stations(places)
            bus.is_troubled = True
    except EapError:
        bus.is_troubled = True  # the line has changed meanwhile: look again


def _places(bus: Bus, stations: Sequence[int], now_ns: int) -> list[tuple[int, int]]:
    """Return positions and station addresses; a lost slave comes behind those before it."""
    order = {station: number for number, station in enumerate(bus.units)}
    lost = [at for at, unit in bus.units.items() if unit.is_lost and unit.retry_ns <= now_ns]
    places = []
    last = -1
    for position, station in enumerate(stations):
        if station in order:
            last = max(last, order[station])
            continue
        fitting = [each for each in lost if order[each] > last]
        if fitting:
            lost.remove(fitting[0])
            last = order[fitting[0]]
            places.append((position, fitting[0]))
    return places
