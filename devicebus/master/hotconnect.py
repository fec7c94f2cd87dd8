"""Optional slaves: their marks, their places while they are absent, and their arrival.

A slave that is plugged in while the bus runs has no station address, or one of before.  It is told
by its identity and by its alias, identification or serial number, else by its position between the
slaves that are known.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from devicebus.errors import BusError, IdentityError
from devicebus.master.bus import BusSlave, BusState, ChangeCount
from devicebus.master.esm import read_identification
from devicebus.master.matching import ExpectedSlave, Marks, describe, fits, has_mark
from devicebus.master.procedure import Procedure, read
from devicebus.master.scan import (
    NOWHERE,
    EscInfo,
    FoundSlave,
    Identity,
    assign_stations,
    count_slaves,
    find_slave,
    read_identity,
    read_topology,
)
from devicebus.wire.register import AlStatus, Register
from devicebus.wire.sii import Sii, SiiFixed
from eap.od.slave_config import ALIAS_REGISTER, BY_SERIAL, ID_REGISTER

PROBE_STATION = 0xFFFE
"""Station address of a slave while it is identified; a bus has fewer slaves."""
_ANY_FMMUS = 16


def absent_slave(expected: ExpectedSlave, station: int, changes: ChangeCount) -> BusSlave:
    """Return an expected slave that is absent, with the process data that is described for it."""
    identity = Identity(
        expected.vendor, expected.product, expected.revision or 0, expected.serial or 0
    )
    found = FoundSlave(
        position=-1,
        station=station,
        alias=expected.alias or 0,
        esc=EscInfo(0, 0, 0, _ANY_FMMUS, 0, 0, 0, 0),
        al_status=AlStatus(0),
        node=NOWHERE,
        identity=identity,
        sii=Sii(fixed=SiiFixed()),
    )
    slave = BusSlave(found, expected.name, changes, expected)
    slave.mark_lost()
    slave.is_absent = True
    slave.channels = expected.channels
    return slave


def read_marks(
    expected: Iterable[ExpectedSlave], station: int, identity: Identity, alias: int
) -> Procedure[Marks]:
    """Return alias, serial number, and the identification if one of *expected* has one.

    Raises WorkingCounterError if the slave does not answer.
    """
    marks = {ALIAS_REGISTER: alias, BY_SERIAL: identity.serial}
    product = identity.vendor, identity.product
    registers = {
        each.config.identification
        for each in expected
        if each.mark is not None and (each.vendor, each.product) == product
    }
    for register in registers - marks.keys():
        if register == ID_REGISTER:
            marks[register] = yield from read_identification(station)
        else:
            octets = yield from read(station, register, 2, "identification")
            marks[register] = int.from_bytes(octets, "little")
    return marks


def identify_arrivals(bus: BusState, stations: Sequence[int]) -> Procedure[list[tuple[int, int]]]:
    """Return position and station address for slaves without a known station address.

    What fits no expected slave that is away goes to ``bus.strangers``.

    Args:
        bus: The bus.
        stations: Station address at each position.
    """
    places: list[tuple[int, int]] = []
    strangers = []
    order = {station: number for number, station in enumerate(bus.slaves)}
    away = {
        at: slave.expected
        for at, slave in bus.slaves.items()
        if slave.is_lost and slave.expected is not None
    }
    known = list(stations)
    for position, station in enumerate(stations):
        # The first slave with an address has it; a later one has kept it from before.
        if station in order and known.index(station) == position:
            away.pop(station, None)
            continue
        yield from assign_stations([(position, PROBE_STATION)])
        identity = yield from read_identity(PROBE_STATION)
        octets = yield from read(PROBE_STATION, Register.STATION_ALIAS, 2, "alias")
        marks = yield from read_marks(
            away.values(), PROBE_STATION, identity, int.from_bytes(octets, "little")
        )
        between = _between(order, known, position)
        fitting = [
            at
            for at, expected in away.items()
            if fits(expected, identity)
            and has_mark(expected, marks)
            and (_is_movable(bus, expected) or order[at] in between)
        ]
        # One with a mark of its own before those that are told by their position only.
        fitting.sort(key=lambda at: away[at].mark is None)
        if fitting:
            known[position] = fitting[0]
            away.pop(fitting[0])
            places.append((position, fitting[0]))
            yield from assign_stations([(position, fitting[0])])
        else:
            strangers.append(f"position {position}: {identity}: expected no slave like this here")
            # The next arrival needs the address of the probe.
            yield from assign_stations([(position, 0)])
    bus.strangers = tuple(strangers)
    return places


def take_in(bus: BusState, slave: BusSlave) -> Procedure[None]:
    """Read registers and EEPROM of a slave that was plugged in, and compare it with the expected.

    Raises:
        IdentityError: it is another one.
        BusError: it cannot join the cycle.
    """
    expected = slave.expected
    found = yield from find_slave(slave.station)
    if expected is not None:
        marks = yield from read_marks([expected], slave.station, found.identity, found.alias)
        if not fits(expected, found.identity) or not has_mark(expected, marks):
            raise IdentityError(
                f"in place of {slave.name} (station {slave.station}) there is {found.identity},"
                f" serial {found.identity.serial}, expected {describe(expected)}"
            )
    if bus.knows_lrw and not found.esc.knows_lrw:
        raise BusError(
            f"slave {slave.station}: it does not know LRW, which the other slaves use: restart the"
            " bus with it"
        )
    slave.found = found
    slave.is_mapped = False


def refresh_topology(bus: BusState) -> Procedure[None]:
    """Read positions and connections of all slaves; their order is that of the segment again."""
    count = yield from count_slaves()
    present: list[BusSlave] = []
    for position, (station, node) in enumerate((yield from read_topology(count))):
        slave = bus.slaves.get(station)
        if slave is not None and slave not in present:
            present.append(slave)
            slave.found = slave.found._replace(position=position, node=node)
    arrivals = iter(present)
    order = [next(arrivals) if slave in present else slave for slave in bus.slaves.values()]
    if order != list(bus.slaves.values()):
        bus.slaves = {slave.station: slave for slave in order}


def _between(order: dict[int, int], stations: Sequence[int], position: int) -> range:
    """Return the numbers of the slaves that may be between the known ones around a position."""
    before = [order[at] for at in stations[:position] if at in order]
    behind = [order[at] for at in stations[position + 1 :] if at in order]
    return range(max(before, default=-1) + 1, min(behind, default=len(order)))


def _is_movable(bus: BusState, expected: ExpectedSlave) -> bool:
    """Return true if a slave may be anywhere: by its mark, or by that of its group."""
    if expected.mark is not None:
        return True
    group = expected.config.group
    return bool(group) and any(
        each.mark is not None and each.config.group == group for each in bus.settings.expected
    )
