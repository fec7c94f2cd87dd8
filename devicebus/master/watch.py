"""Supervision of the slaves of a running bus: states, error counters and mailboxes.

A slave that does not answer is left out of the cycle; a slave that comes back is brought to its
target state.  Every step is an acyclic datagram within the budget of the cycle, so the other slaves
are not disturbed.

The error counters of a controller have no time.  They are read once a second, so that a mended
cable is told from one that still damages frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from devicebus.errors import FrameLostError, IdentityError, WorkingCounterError
from devicebus.master.bring import bring, set_clocks
from devicebus.master.bus import (
    BusBack,
    BusLost,
    BusSlave,
    BusState,
    SlaveAbsent,
    SlaveBack,
    SlaveFailed,
    SlaveLeft,
    SlaveLost,
)
from devicebus.master.cycle import Participation
from devicebus.master.diagnosis import COUNTERS, port_counters
from devicebus.master.hotconnect import identify_arrivals, refresh_topology, take_in
from devicebus.master.mailboxes import STATUS, Mailbox
from devicebus.master.procedure import Procedure, Sleep, Task
from devicebus.master.scan import (
    assign_stations,
    count_slaves,
    in_frames,
    read_identity,
    read_stations,
)
from devicebus.wire.alstatus import ERROR, WITH_PROCESS_DATA, AlState
from devicebus.wire.datagram import DatagramReply, DatagramRequest, aprd, fprd, fpwr
from devicebus.wire.register import AlStatus, Register, SmStatus
from eap.errors import EapError

# Slaves whose registers share one frame.
_PER_STEP = 15


def status_read(mailbox: Mailbox) -> DatagramRequest:
    """Return the datagram that shows whether *mailbox* holds a message."""
    return fprd(mailbox.station, STATUS, 1, tries=1)


def poll_mailboxes(mailboxes: Sequence[Mailbox]) -> Procedure[None]:
    """Poll the idle ones of *mailboxes* and read the full ones."""
    idle = [mailbox for mailbox in mailboxes if not mailbox.is_busy]
    for start in range(0, len(idle), _PER_STEP):
        part = idle[start : start + _PER_STEP]
        try:
            replies, now_ns = yield [status_read(each) for each in part]
        except FrameLostError:
            continue  # the next look comes soon
        for mailbox, reply in zip(part, replies, strict=True):
            if reply.wkc and reply.data[0] & SmStatus.MAILBOX_FULL:
                mailbox.poll(now_ns)


ERRORS_PERIOD_NS = 1_000_000_000


class ErrorPeriod(NamedTuple):
    """First and last time at which the error counters of a port had grown."""

    since_ns: int
    until_ns: int


class PortErrorLog:
    """Log of the times at which error counters have grown, by station address and port."""

    def __init__(self) -> None:
        self._counters: dict[int, tuple[int, ...]] = {}
        self._growth: dict[int, dict[int, ErrorPeriod]] = {}

    def of(self, station: int) -> dict[int, ErrorPeriod]:
        """Return the error periods of a slave by port; a port without errors is missing."""
        return self._growth.get(station, {})

    def clear(self) -> None:
        """Forget all times; the present counters are the new base."""
        self._growth.clear()

    def take(self, station: int, octets: bytes, now_ns: int) -> None:
        """Compare the counters of a slave with those of the poll before.

        Errors before the first poll have an unknown time.  Smaller counters were cleared, or the
        slave was switched off: older times are forgotten.
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
                ports[port] = ErrorPeriod(first, now_ns)


def poll_error_counters(bus: BusState, log: PortErrorLog) -> Procedure[None]:
    """Read the error counters of all slaves that answer."""
    stations = [slave.station for slave in bus.slaves.values() if not slave.is_lost]
    for start in range(0, len(stations), _PER_STEP):
        part = stations[start : start + _PER_STEP]
        try:
            replies, now_ns = yield [fprd(at, Register.RX_ERROR, COUNTERS, tries=1) for at in part]
        except FrameLostError:
            return  # the next poll comes soon
        for station, reply in zip(part, replies, strict=True):
            if reply.wkc:
                log.take(station, reply.data, now_ns)


PERIOD_NS = 100_000_000
"""Poll period of the AL status of all slaves without a fault."""
SLICE_NS = 5_000_000
"""Minimum time between two polls, the second of which follows a faulty cycle."""
RETRY_NS = 1_000_000_000
"""Pause before the next attempt for a slave that could not be brought back."""
_STATES = {int(state): state for state in AlState}


def watch(bus: BusState) -> Procedure[None]:
    """Supervise the slaves without end."""
    while True:
        now_ns = yield from _wait_for_period(bus)
        try:
            count = yield from count_slaves()
            replies = yield from in_frames(
                [fprd(at, Register.AL_STATUS, AlStatus.SIZE) for at in bus.slaves]
            )
        except FrameLostError:
            if not bus.is_lost:
                bus.is_lost = True
                for slave in bus.slaves.values():
                    slave.state = None
                bus.emit(BusLost(now_ns))
            continue
        if bus.is_lost:
            bus.is_lost = False
            bus.emit(BusBack(now_ns))
        doubled = _check_slaves(bus, replies, now_ns)
        if doubled:
            yield from _separate(bus, doubled, count)
        lost = [slave for slave in bus.slaves.values() if slave.is_lost]
        if count <= len(bus.slaves) - len(lost):
            bus.strangers = ()
        elif lost:
            yield from _readdress(bus, count, now_ns)


def _check_slaves(bus: BusState, replies: Sequence[DatagramReply], now_ns: int) -> list[BusSlave]:
    """Handle the AL status of all slaves; return those whose station address another one has."""
    doubled = []
    for slave, reply in zip(list(bus.slaves.values()), replies, strict=True):
        if reply.wkc > 1:
            doubled.append(slave)  # what the two have answered is the state of neither
        elif reply.wkc:
            _check_slave(bus, slave, AlStatus.decode(reply.data), now_ns)
        else:
            _mark_lost(bus, slave, now_ns)
    return doubled


def _wait_for_period(bus: BusState) -> Procedure[int]:
    """Wait for the next poll; return the time."""
    _, now_ns = yield Sleep(0)
    bus.earliest_check_ns = now_ns + SLICE_NS
    _, now_ns = yield Sleep(SLICE_NS if bus.needs_check else PERIOD_NS, bus.alarm)
    bus.needs_check = False
    return now_ns


def _mark_lost(bus: BusState, slave: BusSlave, now_ns: int) -> None:
    """Leave out a slave that does not answer although the frame came back."""
    if slave.is_lost:
        return
    slave.mark_lost()
    slave.is_absent = slave.is_optional
    slave.retry_ns = 0
    slave.missing_since_ns = slave.missing_since_ns or now_ns
    # Cleared first: the end of a cancelled task is not a failed attempt.
    work, slave.work = slave.work, None
    if work is not None:
        work.cancel()
    bus.close_mailbox(slave)
    # Its registers may still be configured: it counts again as soon as it is back on the cable.
    away = Participation.AWAY if slave.is_absent else Participation.UNCERTAIN
    bus.set_participation(slave, away)
    if slave.station == bus.reference:
        # Otherwise the others would receive the time of an empty datagram.
        bus.distribute_time(None)
    event = SlaveAbsent if slave.is_absent else SlaveLost
    bus.emit(event(slave.station, now_ns))


def _check_slave(bus: BusState, slave: BusSlave, status: AlStatus, now_ns: int) -> None:
    """Handle the AL status of a slave: bring it back if it is not in its target state."""
    if slave.is_busy:
        return
    if not slave.is_lost:  # a lost slave's identity is compared before its state counts
        slave.state = _STATES.get(status.state)
    if now_ns < slave.retry_ns:
        return
    is_set_up = slave.is_set_up or slave.target not in WITH_PROCESS_DATA
    if status.state == slave.target and not status.error and is_set_up and not slave.is_lost:
        _report_back(bus, slave, now_ns)
        return
    if slave.missing_since_ns is None:
        slave.missing_since_ns = now_ns
        if slave.is_absent:
            _begin(bus, slave, status, now_ns)
            return
        shown = status.state | (ERROR if status.error else 0)
        bus.emit(SlaveLeft(slave.station, shown, status.code, now_ns))
    _begin(bus, slave, status, now_ns)


def _report_back(bus: BusState, slave: BusSlave, now_ns: int) -> None:
    """Report a slave that has returned to its target state."""
    missing_since_ns, slave.missing_since_ns = slave.missing_since_ns, None
    if missing_since_ns is not None:
        bus.emit(SlaveBack(slave.station, now_ns - missing_since_ns, now_ns))


def _begin(bus: BusState, slave: BusSlave, status: AlStatus, now_ns: int) -> None:
    # A slave that only left OP keeps its registers; all others are configured from INIT again.
    stays = (
        not slave.is_lost
        and status.state in WITH_PROCESS_DATA
        and slave.target in WITH_PROCESS_DATA
        and slave.is_set_up
    )
    bus.needs_check = True

    def done(task: Task[int]) -> None:
        error = task.error
        if slave.work is not task or isinstance(error, FrameLostError):
            return  # the slave was lost meanwhile, or no frame came back: the next poll tries again
        if error is None:
            _report_back(bus, slave, task.result())
        # A lost slave that does not answer yet has had its event: no failure is reported.
        elif not (slave.is_lost and isinstance(error, WorkingCounterError)):
            slave.retry_ns = now_ns + RETRY_NS
            if isinstance(error, IdentityError):
                slave.mark_lost()
                bus.close_mailbox(slave)
                if slave.is_absent:
                    return  # the other one is named as a stranger at its position
            bus.emit(SlaveFailed(slave.station, str(error), now_ns))

    work = _bring_back(bus, slave, stays=stays)
    task = bus.runner.start(work, now_ns, f"bringing back slave {slave.station}")
    slave.start_work(task)
    task.watch(done)


def _bring_back(bus: BusState, slave: BusSlave, *, stays: bool) -> Procedure[int]:
    """Bring a slave back to its target state, by INIT unless it *stays*; return the time."""
    if not stays:
        try:
            yield from _recognize(bus, slave)
        except IdentityError:
            # The other device must not answer under this station address.
            yield [fpwr(slave.station, Register.STATION_ADDRESS, bytes(2))]
            raise
        yield from bring(bus, slave, AlState.INIT)
        was_absent = slave.is_absent
        slave.is_lost = slave.is_absent = False
        if was_absent:
            yield from refresh_topology(bus)
        if bus.uses_clocks:
            yield from set_clocks(bus, only=frozenset((slave.station,)))
    yield from bring(bus, slave, slave.target)
    _, now_ns = yield Sleep(0)
    return now_ns


def _recognize(bus: BusState, slave: BusSlave) -> Procedure[None]:
    """Compare a slave that came back with the one that was there, or that is expected.

    Raises IdentityError if it is another one.
    """
    found = slave.found.identity
    identity = yield from read_identity(slave.station)
    if slave.is_absent or (identity != found and slave.expected is not None):
        yield from take_in(bus, slave)
    elif identity != found:
        raise IdentityError(
            f"in place of {slave.name} (station {slave.station}) there is {identity}, serial"
            f" {identity.serial}, expected {found}, serial {found.serial}"
        )


def _separate(bus: BusState, doubled: Sequence[BusSlave], count: int) -> Procedure[None]:
    """Take the station address from slaves that were plugged in with that of another."""
    try:
        stations = yield from read_stations(count)
        replies = yield from in_frames(
            [aprd(at, Register.AL_STATUS, AlStatus.SIZE) for at in range(count)]
        )
        statuses = [AlStatus.decode(reply.data) for reply in replies]
        for slave in doubled:
            places = [at for at, station in enumerate(stations) if station == slave.station]
            # The slave of this bus is in its target state, or at its position.
            places.sort(
                key=lambda at, slave=slave: (  # type: ignore[misc]
                    statuses[at].state != slave.target or bool(statuses[at].error),
                    at != slave.found.position,
                )
            )
            yield from assign_stations([(at, 0) for at in places[1:]])
    except EapError:
        pass  # the segment has changed meanwhile
    bus.needs_check = True


def _readdress(bus: BusState, count: int, now_ns: int) -> Procedure[None]:
    """Assign slaves without a station address that of the lost slave at their position."""
    try:
        stations = yield from read_stations(count)
        if any(slave.is_absent for slave in bus.slaves.values()):
            if now_ns >= bus.probe_ns or len(bus.strangers) != count - _known(bus, stations):
                bus.probe_ns = now_ns + RETRY_NS
                bus.needs_check |= bool((yield from identify_arrivals(bus, stations)))
            return
        places = _missing_addresses(bus, stations, now_ns)
        if places:
            yield from assign_stations(places)
            bus.needs_check = True
    except EapError:
        bus.needs_check = True  # the segment has changed meanwhile: poll again


def _known(bus: BusState, stations: Sequence[int]) -> int:
    return sum(station in bus.slaves for station in stations)


def _missing_addresses(
    bus: BusState, stations: Sequence[int], now_ns: int
) -> list[tuple[int, int]]:
    """Return positions and station addresses to assign; lost slaves keep their order."""
    order = {station: number for number, station in enumerate(bus.slaves)}
    lost = [at for at, slave in bus.slaves.items() if slave.is_lost and slave.retry_ns <= now_ns]
    places = []
    last = -1
    for position, station in enumerate(stations):
        # A slave that lost its power has no station address; the known slaves around its position
        # tell which one it is.
        if station in order:
            last = max(last, order[station])
            continue
        fitting = [each for each in lost if order[each] > last]
        if fitting:
            lost.remove(fitting[0])
            last = order[fitting[0]]
            places.append((position, fitting[0]))
    return places
