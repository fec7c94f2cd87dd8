"""Procedures that bring all slaves of a bus to a state, and back to INIT."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from devicebus.errors import BusError, StateTimeoutError
from devicebus.master.bring import LOOP_CONTROL, bring, set_clocks
from devicebus.master.bus import BusSlave, BusState
from devicebus.master.configuration import prepare_safeop, run_writes, transition_of
from devicebus.master.cycle import Cycle
from devicebus.master.esm import POLL_NS, TIMEOUT_NS
from devicebus.master.findings import join_errors
from devicebus.master.hotconnect import absent_slave, read_marks
from devicebus.master.image import BusImage, SlaveProcessData, plan_image
from devicebus.master.matching import ExpectedSlave, Marks, match_slaves
from devicebus.master.pdo import ProcessDataChannel, channels_from_sii
from devicebus.master.procedure import Procedure, Sleep, together
from devicebus.master.scan import FoundSlave, assign_stations, scan
from devicebus.wire.alstatus import WITH_PROCESS_DATA, AlState
from devicebus.wire.datagram import brd, bwr
from devicebus.wire.register import AlControl, AlStatus, Register
from eap.errors import EapError


def start_up(bus: BusState, target: AlState) -> Procedure[None]:
    """Find all slaves and bring them to *target*, from INIT to OP, together.

    OP needs cycles as soon as the bus has a Cycle.  A slave that fails is left out; the others go
    on without it.

    Raises:
        IdentityError: the slaves are not the expected ones.
        BusError: slaves did not reach the state; the message has a line for each cause.
    """
    bus.reset()
    # The slaves may run under another master: outputs go off before anything is reconfigured.
    yield [bwr(Register.AL_CONTROL, AlControl(AlState.INIT).encode())]
    if bus.ring is not None:
        # A master that died while it measured delays has left the ring opened.
        yield [bwr(LOOP_CONTROL, b"\0")]
    bus.found = found = yield from scan(bus.settings.first_station)
    slaves = yield from _identify(bus, found)
    bus.slaves = {slave.station: slave for slave in slaves}
    bus.locate_cut()
    for slave in slaves:
        slave.target = target
    starting = _StartingSlaves([slave for slave in slaves if not slave.is_absent])
    yield from starting.run_all(lambda slave: bring(bus, slave, AlState.INIT))
    if target is not AlState.INIT:
        yield from starting.run_all(lambda slave: bring(bus, slave, AlState.PREOP))
    if target in WITH_PROCESS_DATA:
        yield from starting.run_all(lambda slave: _read_process_data(bus, slave))
        if starting.remaining:
            yield from _run_process_data(bus, starting, target)
    starting.check()


def shut_down(bus: BusState) -> Procedure[None]:
    """Bring all slaves to INIT, and forget them.

    Raises:
        StateTimeoutError: a slave stays in another state.
        FrameLostError: no frame comes back.
    """
    slaves = [slave for slave in bus.slaves.values() if slave.mailbox is not None]
    # Best effort: a slave that refuses a write, or does not answer, goes to INIT all the same.
    yield from together([_run_last_writes(bus, slave) for slave in slaves])
    bus.reset()
    yield [bwr(Register.AL_CONTROL, AlControl(AlState.INIT).encode())]
    _, now_ns = yield Sleep(0)
    deadline_ns = now_ns + TIMEOUT_NS[AlState.INIT]
    while now_ns < deadline_ns:
        # BRD ORs the states of all slaves: INIT (1) alone means that all are there.
        (reply,), _ = yield [brd(Register.AL_STATUS, AlStatus.SIZE)]
        if AlStatus.decode(reply.data).state in {0, AlState.INIT}:
            return
        _, now_ns = yield Sleep(POLL_NS)
    raise StateTimeoutError("some slaves are not in INIT within 5 s")


def _run_last_writes(bus: BusState, slave: BusSlave) -> Procedure[None]:
    """Send the start-up writes of the transition from the slave's state to INIT."""
    transition = transition_of(slave.state or AlState.INIT, AlState.INIT)
    if transition is not None:
        yield from run_writes(bus, slave, transition)


def set_up_cycle(bus: BusState) -> None:
    """Plan the process image of all slaves and create the cycle."""
    slaves = bus.slaves.values()
    layout = plan_image([slave.process_data for slave in slaves])
    knows_lrw = bus.settings.allow_lrw and all(slave.found.esc.knows_lrw for slave in slaves)

    bus.image = BusImage(layout)
    bus.knows_lrw = knows_lrw
    bus.cycle = Cycle(bus.link, bus.image, bus.check_soon, knows_lrw=knows_lrw)
    bus.distribute_time(bus.reference)


def _identify(bus: BusState, found: Sequence[FoundSlave]) -> Procedure[list[BusSlave]]:
    """Return the slaves in the order of the segment, with their configured names and stations."""
    expected = bus.settings.expected
    if not expected:
        return [BusSlave(slave, slave.name, bus.changes) for slave in found]
    marks = yield from _read_marks(expected, found)
    order = match_slaves(expected, found, marks)
    stations = [bus.settings.first_station + number for number in order]
    moved = [
        (slave.position, station)
        for slave, station in zip(found, stations, strict=True)
        if slave.station != station
    ]
    if moved:
        yield from assign_stations(moved)
    present = {
        number: BusSlave(
            slave._replace(station=station), expected[number].name, bus.changes, expected[number]
        )
        for slave, station, number in zip(found, stations, order, strict=True)
    }
    slaves = list(present.values())
    for number, each in enumerate(expected):
        if number not in present:
            absent = absent_slave(each, bus.settings.first_station + number, bus.changes)
            # Behind the one that is configured before it, wherever that is on the bus.
            before = [
                (slave.station, at)
                for at, slave in enumerate(slaves, 1)
                if slave.station < absent.station
            ]
            slaves.insert(max(before, default=(0, 0))[1], absent)
    return slaves


def _read_marks(
    expected: Sequence[ExpectedSlave], found: Sequence[FoundSlave]
) -> Procedure[list[Marks]]:
    """Return the marks of the found slaves; identifications are read where one is expected."""
    results = yield from together(
        [read_marks(expected, slave.station, slave.identity, slave.alias) for slave in found]
    )
    for result in results:
        if isinstance(result, EapError):
            raise result
    return [result for result in results if not isinstance(result, EapError)]


def _run_process_data(bus: BusState, starting: _StartingSlaves, target: AlState) -> Procedure[None]:
    """Plan the process image and bring the remaining slaves to SAFEOP or OP."""
    # Failed slaves get a part of the image by their description or EEPROM: they can return without
    # a new layout.
    for slave, _ in starting.errors:
        described = slave.expected.channels if slave.expected is not None else ()
        slave.channels = described or _channels_by_eeprom(slave)
    # Clocks are set before SAFEOP, where slaves with SYNC0 check them.
    if bus.uses_clocks:
        yield from set_clocks(bus)
    set_up_cycle(bus)
    yield from starting.run_all(lambda slave: bring(bus, slave, AlState.SAFEOP))
    if target is AlState.OP:
        yield from starting.run_all(lambda slave: bring(bus, slave, AlState.OP))


def _read_process_data(bus: BusState, slave: BusSlave) -> Procedure[None]:
    """Configure and read the process data of a slave, and check that it fits a frame."""
    yield from prepare_safeop(bus, slave)
    plan_image([slave.process_data])


def _channels_by_eeprom(slave: BusSlave) -> tuple[ProcessDataChannel, ...]:
    """Return the process data of a failed slave by its EEPROM, for its return."""
    channels = channels_from_sii(slave.found.sii)
    try:
        plan_image([SlaveProcessData(slave.station, channels, slave.found.esc.fmmus)])
    except BusError:
        return ()
    return channels


class _StartingSlaves:
    """Slaves that are started together, step by step.

    Attributes:
        remaining: Slaves without an error.
        errors: The other slaves with their errors.
    """

    def __init__(self, slaves: Sequence[BusSlave]) -> None:
        self.remaining = list(slaves)
        self.errors: list[tuple[BusSlave, EapError]] = []

    def run_all(self, work: Callable[[BusSlave], Procedure[None]]) -> Procedure[None]:
        """Run a procedure for each remaining slave in lockstep; raises FrameLostError."""
        results = yield from together([work(slave) for slave in self.remaining])
        done = list(zip(self.remaining, results, strict=True))
        self.errors += [(slave, error) for slave, error in done if isinstance(error, EapError)]
        self.remaining = [slave for slave, error in done if not isinstance(error, EapError)]

    def check(self) -> None:
        """Raise the errors: a single one as it is, several as one with a line for each cause."""
        if self.errors:
            raise join_errors(
                [(f"{slave.name} ({slave.station})", error) for slave, error in self.errors]
            )
