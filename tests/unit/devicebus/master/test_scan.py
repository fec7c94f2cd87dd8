from __future__ import annotations

import pytest

from devicebus.errors import BusError, FrameLostError, IdentityError, WorkingCounterError
from devicebus.master.scan import (
    ExpectedSlave,
    Identity,
    assign_stations,
    check_bus,
    count_slaves,
    find_topology,
    fits,
    iter_differences,
    match_aliases,
    open_ports,
    read_identity,
    read_stations,
    scan,
)
from devicebus.sim.segment import dl_status
from devicebus.wire.datagram import DatagramReply
from devicebus.wire.register import DlStatus
from tests.support.busline import Bench, Line, drive, run, segment, slave


def status(*ports):
    return DlStatus.decode(dl_status(frozenset(ports)).to_bytes(2, "little"))


@pytest.mark.parametrize("ports", [(), (0,), (0, 1), (0, 1, 2, 3)])
def test_open_ports(ports):
    assert open_ports(status(*ports)) == ports


def parents(*ports):
    return [(node.parent, node.parent_port) for node in find_topology([status(*p) for p in ports])]


def test_a_line():
    assert parents((0, 1), (0, 1), (0,)) == [(None, 0), (0, 1), (1, 1)]


def test_branches_are_left_at_port_3_first_and_then_1_and_2():
    assert parents((0, 1, 2, 3), (0, 1), (0,), (0,), (0,)) == [
        (None, 0),
        (0, 3),
        (1, 1),
        (0, 1),
        (0, 2),
    ]


def test_topology_tolerates_open_ends_and_slaves_without_ports():
    assert parents((0, 1), (0, 1)) == [(None, 0), (0, 1)]
    assert parents((0,), ()) == [(None, 0), (None, 0)]
    assert find_topology([status(1, 2)])[0].entry_port == 1
    assert find_topology([]) == ()


def bench_line(*slaves):
    return Line(Bench(), segment(*slaves))


def test_scan_returns_identity_and_topology():
    line = bench_line(
        slave("a", vendor=2, product=3, revision=4, serial=5, alias=77),
        slave("b", clock=None),
        slave("branch", after="a", port=3),
    )
    found = run(line, scan())
    assert [(each.position, each.station, each.name) for each in found] == [
        (0, 1001, "a"), (1, 1002, "branch"), (2, 1003, "b"),
    ]  # fmt: skip
    assert found[0].identity == Identity(2, 3, 4, 5)
    assert str(found[0].identity) == ("vendor 0x00000002, product 0x00000003, revision 0x00000004")
    assert [each.alias for each in found] == [77, 0, 0]
    assert [each.esc.has_clock for each in found] == [True, True, False]
    assert found[0].esc.knows_lrw
    assert [each.node.parent for each in found] == [None, 0, 0]
    assert [each.al_status.state for each in found] == [1, 1, 1]
    assert found[0].sii.sync_managers
    assert [each.esc.station for each in line.segment.slaves] == [1001, 1003, 1002]


def test_sixteen_slaves_share_frames():
    line = bench_line(*[slave(f"s{n}") for n in range(16)])
    assert len(run(line, scan(2001))) == 16
    one = bench_line(slave("s"))
    run(one, scan())
    assert line.frames < 5 * one.frames


def test_scan_of_an_empty_bus_and_without_frames():
    line = bench_line(slave("a"))
    line.segment.cut(0)
    with pytest.raises(FrameLostError):
        run(line, scan())
    assert drive(scan(), lambda _: DatagramReply(b"\0", 0)) == ()


def test_scan_refuses_too_many_slaves():
    with pytest.raises(BusError, match="65000 slaves answered"):
        drive(scan(), lambda _: DatagramReply(b"\0", 65000))


def test_scan_with_lost_frames_succeeds():
    line = bench_line(*[slave(f"s{n}") for n in range(4)])
    line.lose_out = lambda number: number % 7 == 3
    line.lose_back = lambda number: number % 5 == 2
    assert [each.name for each in run(line, scan())] == ["s0", "s1", "s2", "s3"]


def test_scan_unreadable_eeprom_concerns_its_slave_only():
    line = bench_line(slave("a"), slave("b"))
    esc = line.segment.slaves[0].esc
    esc.eeprom.image[128:132] = b"\x0a\0\xff\x0f"
    found = run(line, scan())
    assert "slave 1001: its EEPROM cannot be used" in found[0].fault
    assert (found[0].name, found[0].identity) == ("slave 1001", Identity(0, 0, 0, 0))
    assert (found[1].fault, found[1].name) == ("", "b")


def test_scan_slave_lost_meanwhile_is_an_error():
    line = bench_line(slave("a"), slave("b"))
    with pytest.raises(WorkingCounterError, match="position 2"):
        run(line, assign_stations([(0, 1001), (2, 1003)]))
    begun = line.core.runner.start(scan(), line.now_ns)
    for _ in range(2):
        line.step(line.now_ns)
    line.segment.cut(1)
    with pytest.raises(WorkingCounterError, match="slave 1002: reading registers"):
        line.wait(begun)
    assert run(line, count_slaves()) == 1


def test_station_addresses_and_identities_on_their_own():
    line = bench_line(slave("a", vendor=9), slave("b"))
    run(line, assign_stations([(1, 1007)]))
    assert run(line, read_stations(3)) == [0, 1007, 0]
    run(line, assign_stations([(0, 1001)]))
    assert run(line, read_identity(1001)).vendor == 9


FOUND = run(
    Line(
        Bench(),
        segment(
            slave("coupler", product=1),
            slave("valve", product=2, serial=12, alias=5),
            slave("drive", product=3),
        ),
    ),
    scan(),
)
COUPLER, VALVE, DRIVE = (
    ExpectedSlave(name=f"the {name}", vendor=0xE5A, product=number)
    for number, name in enumerate(("coupler", "valve", "drive"), 1)
)


def differences(*expected, found=FOUND):
    return list(iter_differences(expected, found))


def test_check_bus_accepts_the_expected_slaves():
    check_bus([COUPLER, VALVE, DRIVE], FOUND)
    exact = ExpectedSlave(name="v", vendor=0xE5A, product=2, revision=0x10000, serial=12, alias=5)
    check_bus([COUPLER, exact, DRIVE], FOUND)


def test_check_bus_missing_slave_is_one_difference():
    assert differences(COUPLER, VALVE, DRIVE, found=[FOUND[0], FOUND[2]]) == [
        "the valve is missing after coupler, expected vendor 0x00000E5A, product 0x00000002"
    ]
    (line,) = differences(COUPLER, VALVE, found=FOUND[1:2])
    assert line.startswith("the coupler is missing at the start")


def test_check_bus_additional_slave_is_one_difference():
    (line,) = differences(COUPLER, DRIVE)
    assert line == (
        "position 1 (station 1002): vendor 0x00000E5A, product 0x00000002,"
        " revision 0x00010000, expected no slave here"
    )


def test_check_bus_other_slave_is_a_difference():
    (line,) = differences(COUPLER, DRIVE, DRIVE)
    assert line == (
        "position 1 (station 1002): vendor 0x00000E5A, product 0x00000002, revision 0x00010000,"
        " expected the drive with vendor 0x00000E5A, product 0x00000003"
    )


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"revision": 2}, "0x00000002, revision 0x00000002"),
        ({"serial": 99}, "0x00000002, serial 99"),
        ({"alias": 6}, "alias 5, expected v with alias 6"),
    ],
)  # fmt: skip
def test_details_are_compared_when_they_are_named(options, text):
    valve = ExpectedSlave(name="v", vendor=0xE5A, product=2, **options)
    (line,) = differences(COUPLER, valve, DRIVE)
    assert text in line


def test_check_bus_unreadable_slave_has_its_reason():
    broken = FOUND[1]._replace(fault="slave 1002: broken", identity=Identity(0, 0, 0))
    (line,) = differences(COUPLER, VALVE, DRIVE, found=[FOUND[0], broken, FOUND[2]])
    assert line == "position 1 (station 1002): slave 1002: broken, expected the valve"


def test_check_bus_reports_all_differences():
    with pytest.raises(IdentityError) as caught:
        check_bus([VALVE, DRIVE, COUPLER], FOUND)
    assert str(caught.value).startswith(
        "the bus is not as configured (3 slaves expected, 3 found):\n  "
    )
    assert len(str(caught.value).splitlines()) == 4


def test_whether_a_slave_fits():
    assert fits(VALVE, Identity(0xE5A, 2, 1, 1))
    assert not fits(VALVE, Identity(0xE5B, 2, 1, 1))


@pytest.mark.parametrize(
    ("expected", "there", "order"),
    [
        ((None, None), (0, 0), (0, 1)),
        ((0, 5, None, 6, None), (0, 5, 0, 6, 0), (0, 1, 2, 3, 4)),
        ((0, 5, None, 6, None), (0, 6, 0, 5, 0), (0, 3, 4, 1, 2)),
        ((5, 6, 7), (7, 5, 6), (2, 0, 1)),
        ((5, 6), (6, 9), (0, 1)),
        ((5, 6), (6, 5, 5), (0, 1)),
        ((5, 5), (5, 5), (0, 1)),
        ((5, 6), (6,), (0, 1)),
        ((None, 6), (6, 3), (0, 1)),
    ],
)
def test_match_aliases_finds_slaves_at_any_position(expected, there, order):
    slaves = [ExpectedSlave(name="s", vendor=1, product=1, alias=alias) for alias in expected]
    assert match_aliases(slaves, there) == order
