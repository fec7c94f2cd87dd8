"""From an unknown bus to one that runs, and to one that rests."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from devicebus.errors import BusError, StateTimeoutError
from devicebus.master.bring import bring, read_process_data, set_clocks
from devicebus.master.bus import Bus, Unit
from devicebus.master.cycle import Cycle
from devicebus.master.esm import POLL_NS, TIMEOUT_NS
from devicebus.master.findings import join_errors
from devicebus.master.image import BusImage, SlaveShape, lay_out
from devicebus.master.pdo import Channel, channels_from_sii
from devicebus.master.procedure import Procedure, Sleep, together
from devicebus.master.scan import FoundSlave, arrange, assign_stations, check_bus, scan
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import brd, bwr
from devicebus.wire.register import AlControl, AlStatus, Register
from eap.errors import EapError

_WITH_PROCESS_DATA = frozenset((AlState.SAFEOP, AlState.OP))


def start_up(bus: Bus, target: AlState) -> Procedure[None]:
    """Find all slaves and bring them to *target*, INIT to OP, together.

    For OP cycles have to run as soon as the bus has one.  Slaves that fail are left behind and the
    others go on without them.

    Raises:
        IdentityError: the bus is not the expected one.
        BusError: slaves did not get there; the message names each and why.
    """
    bus.forget()
    yield [bwr(Register.AL_CONTROL, AlControl(AlState.INIT).encode())]
    found = yield from scan(bus.settings.first_station)
    units = yield from _identify(bus, found)
    bus.units = {unit.station: unit for unit in units}
    for unit in units:
        unit.target = target
    crew = _Crew(units)
    yield from crew.do(lambda unit: bring(bus, unit, AlState.INIT))
    if target is not AlState.INIT:
        yield from crew.do(lambda unit: bring(bus, unit, AlState.PREOP))
    if target in _WITH_PROCESS_DATA:
        yield from crew.do(lambda unit: _plan(bus, unit))
        if crew.fit:
            yield from _run_process_data(bus, crew, target)
    crew.check()


def shut_down(bus: Bus) -> Procedure[None]:
    """Bring all slaves to INIT, and keep nobody anywhere any more.

    Raises:
        StateTimeoutError: some stay in another state.
        FrameLostError: nothing comes back.
    """
    bus.forget()
    yield [bwr(Register.AL_CONTROL, AlControl(AlState.INIT).encode())]
    _, now_ns = yield Sleep(0)
    deadline_ns = now_ns + TIMEOUT_NS[AlState.INIT]
    while now_ns < deadline_ns:
        (reply,), _ = yield [brd(Register.AL_STATUS, AlStatus.SIZE)]
        if AlStatus.decode(reply.data).state in {0, AlState.INIT}:
            return
        _, now_ns = yield Sleep(POLL_NS)
    raise StateTimeoutError("some slaves are not in INIT within 5 s")


def set_up_cycle(bus: Bus) -> None:
    """Lay out the process data of all slaves, so that cycles can run."""
    units = bus.units.values()
    layout = lay_out([_shape(unit) for unit in units])
    knows_lrw = bus.settings.allow_lrw and all(unit.found.esc.knows_lrw for unit in units)

    def trouble(now_ns: int) -> None:
        del now_ns
        bus.is_troubled = True

    bus.image = BusImage(layout)
    bus.cycle = Cycle(bus.link, bus.image, trouble, knows_lrw=knows_lrw)
    bus.follow(bus.reference)


def _identify(bus: Bus, found: Sequence[FoundSlave]) -> Procedure[list[Unit]]:
    """Return the slaves in the order of the line, with the names and stations they are to have."""
    expected = bus.settings.expected
    if not expected:
        return [Unit(slave, slave.name, bus.changes) for slave in found]
    order = arrange(expected, [slave.alias for slave in found])
    check_bus([expected[number] for number in order], found)
    stations = [bus.settings.first_station + number for number in order]
    moved = [
        (slave.position, station)
        for slave, station in zip(found, stations, strict=True)
        if slave.station != station
    ]
    if moved:
        yield from assign_stations(moved)
    return [
        Unit(slave._replace(station=station), expected[number].name, bus.changes)
        for slave, station, number in zip(found, stations, order, strict=True)
    ]


def _run_process_data(bus: Bus, crew: _Crew, target: AlState) -> Procedure[None]:
    """Lay out process data and bring those that are left to SAFEOP or OP."""
    for unit, _ in crew.errors:
        unit.channels = _believed(unit)
    if bus.settings.clocks:
        yield from set_clocks(bus)
    set_up_cycle(bus)
    yield from crew.do(lambda unit: bring(bus, unit, AlState.SAFEOP))
    if target is AlState.OP:
        yield from crew.do(lambda unit: bring(bus, unit, AlState.OP))


def _plan(bus: Bus, unit: Unit) -> Procedure[None]:
    """Find out what a slave exchanges, and that it fits the bus."""
    yield from read_process_data(bus, unit)
    lay_out([_shape(unit)])


def _believed(unit: Unit) -> tuple[Channel, ...]:
    """Return what a slave that has failed may exchange once it comes back, by its EEPROM."""
    channels = channels_from_sii(unit.found.sii)
    try:
        lay_out([SlaveShape(unit.station, channels, unit.found.esc.fmmus)])
    except BusError:
        return ()
    return channels


def _shape(unit: Unit) -> SlaveShape:
    return SlaveShape(unit.station, unit.channels, unit.found.esc.fmmus)


class _Crew:
    """The slaves that go from step to step together.

    Attributes:
        fit: Those that are left.
        errors: What went wrong with the others.
    """

    def __init__(self, units: Sequence[Unit]) -> None:
        self.fit = list(units)
        self.errors: list[tuple[Unit, EapError]] = []

    def do(self, work: Callable[[Unit], Procedure[None]]) -> Procedure[None]:
        """Let all that are left do something together; raises FrameLostError."""
        results = yield from together([work(unit) for unit in self.fit])
        done = list(zip(self.fit, results, strict=True))
        self.errors += [(unit, error) for unit, error in done if isinstance(error, EapError)]
        self.fit = [unit for unit, error in done if not isinstance(error, EapError)]

    def check(self) -> None:
        """Raise what went wrong: one error as it is, several as one with a line for each cause."""
        if self.errors:
            raise join_errors(
                [(f"{unit.name} ({unit.station})", error) for unit, error in self.errors]
            )
