"""Words for changed buses."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from eap.od.slave_config import (
    IdnWrite,
    MappedObject,
    OpMode,
    RevisionRule,
    SdoWrite,
    SlaveConfig,
    Transition,
    Watchdogs,
)
from eap.pd.spec import BusEntrySpec, BusPortSpec, BusSlaveSpec, BusTarget
from eap.runtime.bus_change import describe_bus_changes
from tests.support.cyclic import bus_port, station

SLAVE = BusSlaveSpec("drive", 1001, 2, 0x50, config=SlaveConfig())


def changes(before: BusPortSpec, after: BusPortSpec, **more: object) -> list[str]:
    """Return the lines for a changed bus, and changed keys of the station."""
    port = bus_port()
    old = station(ports=(replace(port, bus=before),))
    new = replace(old, ports=(replace(port, bus=after),), **more)
    return list(describe_bus_changes(old, new))


def test_settings_of_the_port_are_named_behind_the_effect():
    before = BusPortSpec(slaves=(SLAVE,))
    after = replace(before, target=BusTarget.SAFEOP, frame_timeout_us=5000)
    assert changes(before, before) == []
    assert changes(before, after) == [
        "bus0 restarts: its slaves go to INIT, and to SAFEOP again",
        "bus0: target OP -> SAFEOP",
        "bus0: frame_timeout_us 1000000 -> 5000",
    ]


def test_changed_cycle_is_named_for_a_bus_with_clocks():
    bus = BusPortSpec(clocks=True)
    cycle_us = station().cycle_us
    assert changes(bus, bus, cycle_us=2 * cycle_us) == [
        "bus0 restarts: its slaves go to INIT, and to OP again",
        f"bus0: cycle_us {cycle_us} -> {2 * cycle_us}",
    ]


def test_slaves_come_and_go_by_name():
    new = BusSlaveSpec("valve", 1002, 2, 0x51, config=SlaveConfig(optional=True))
    one, both = BusPortSpec(slaves=(SLAVE,)), BusPortSpec(slaves=(SLAVE, new))
    assert changes(one, both)[1:] == ["bus0.valve: added, optional, station address 1002"]
    assert changes(both, one)[1:] == ["bus0.valve: removed"]
    moved = (replace(new, station=1001), replace(SLAVE, station=1002))
    assert changes(both, BusPortSpec(slaves=moved))[1:] == [
        "bus0.valve: station address 1002 -> 1001",
        "bus0.drive: station address 1001 -> 1002",
    ]


WRITE = SdoWrite(index=0x6060, data=b"\x08")


@pytest.mark.parametrize(
    ("before", "after", "line"),
    [
        ({}, {"writes": (WRITE,)}, "start-up write PS 0x6060:00 none -> 08"),
        (
            {"writes": (WRITE,)},
            {"writes": (replace(WRITE, data=b"\x09"),)},
            "start-up write PS 0x6060:00 08 -> 09",
        ),
        (
            {"writes": (WRITE, replace(WRITE, data=b"\x09"))},
            {"writes": (replace(WRITE, data=b"\x09"), WRITE)},
            "start-up write PS 0x6060:00 08, 09 -> 09, 08",
        ),
        (
            {},
            {"writes": (IdnWrite(at=(Transition.SO,), idn=0x8001, data=b"", drive=2),)},
            "start-up write SO P-0-0001 of drive 2 none -> empty",
        ),
        (
            {},
            {"writes": (SdoWrite(index=0x8000, subindex=1, data=b"\x00\x01", complete=True),)},
            "start-up write PS 0x8000:01 complete none -> 00 01",
        ),
        (
            {"assignment": {2: (0x1600,)}},
            {"assignment": {2: (0x1600, 0x1601)}},
            "PDOs of sync manager 2 0x1600 -> 0x1600, 0x1601",
        ),
        (
            {},
            {"mapping": {0x1A00: (MappedObject(0x6041, 0, 16), MappedObject(0, 0, 8))}},
            "mapping of 0x1A00 none -> 0x6041:00/16, 0/8",
        ),
        (
            {},
            {"sync": OpMode(shift0_ns=250_000)},
            "SYNC off -> 0x0300 (shift0 250 us, factor0 1)",
        ),
        ({}, {"watchdogs": Watchdogs(process_data_ms=50)}, "watchdog.process_data_ms none -> 50"),
        ({}, {"optional": True}, "optional false -> true"),
        ({}, {"group": "left"}, "group none -> left"),
        ({}, {"identification": 0x0134}, "identification 0x0012 -> id"),
        ({}, {"fixed_pdos": True}, "PDO assignment written -> fixed"),
    ],
)
def test_configuration_of_a_slave_is_compared_by_its_parts(before, after, line):
    old, new = (replace(SLAVE, config=SlaveConfig(**each)) for each in (before, after))
    lines = changes(BusPortSpec(slaves=(old,)), BusPortSpec(slaves=(new,)))
    assert lines[1:] == [f"bus0.drive: {line}"]


def test_identity_and_process_data_are_compared():
    entry = BusEntrySpec("bus0.drive.status", 0x6041, 0, 16)
    rule = SlaveConfig(revision_rule=RevisionRule.AT_LEAST)
    new = replace(SLAVE, product=0x51, revision=3, serial=9, inputs=(entry,), config=rule)
    assert changes(BusPortSpec(slaves=(SLAVE,)), BusPortSpec(slaves=(new,)))[1:] == [
        "bus0.drive: product 0x00000050 -> 0x00000051",
        "bus0.drive: revision none -> revision 0x00000003 or later",
        "bus0.drive: serial none -> 9",
        "bus0.drive: inputs none -> 0x6041:00/16",
    ]


def test_long_lists_are_shortened():
    entries = tuple(BusEntrySpec("", 0x6000, number, 16) for number in range(30))
    (line,) = changes(
        BusPortSpec(slaves=(SLAVE,)), BusPortSpec(slaves=(replace(SLAVE, outputs=entries),))
    )[1:]
    assert len(line) < 100
    assert line.endswith("…")
