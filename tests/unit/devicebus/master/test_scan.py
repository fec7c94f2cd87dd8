from __future__ import annotations

import pytest

from devicebus.errors import BusError, FrameLostError, WorkingCounterError
from devicebus.master.scan import (
    Identity,
    assign_stations,
    count_slaves,
    find_topology,
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
def test_open_ports_are_those_of_dl_status(ports):
    assert open_ports(status(*ports)) == ports


def parents(*ports):
    return [(node.parent, node.parent_port) for node in find_topology([status(*p) for p in ports])]


def test_slaves_of_a_line_have_one_parent_each():
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
