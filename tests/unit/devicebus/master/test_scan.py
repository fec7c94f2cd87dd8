from __future__ import annotations

import pytest

from devicebus.errors import BusError, FrameLostError, WorkingCounterError
from devicebus.master.access import DatagramReply
from devicebus.master.scan import (
    Identity,
    assign_stations,
    count_slaves,
    read_identity,
    read_stations,
    scan,
)
from tests.support.busline import Bench, Line, drive, run, segment, slave


def bench_line(*slaves):
    return Line(Bench(), segment(*slaves))


def test_a_scan_tells_who_is_there_and_how_they_are_wired():
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
    assert [each.joint.parent for each in found] == [None, 0, 0]
    assert [each.al_status.state for each in found] == [1, 1, 1]
    assert found[0].sii.sync_managers
    assert [each.esc.station for each in line.segment.slaves] == [1001, 1003, 1002]


def test_sixteen_slaves_share_frames():
    line = bench_line(*[slave(f"s{n}") for n in range(16)])
    assert len(run(line, scan(2001))) == 16
    one = bench_line(slave("s"))
    run(one, scan())
    assert line.frames < 5 * one.frames


def test_an_empty_bus_and_no_bus_at_all():
    line = bench_line(slave("a"))
    line.segment.cut(0)
    with pytest.raises(FrameLostError):
        run(line, scan())
    assert drive(scan(), lambda _: DatagramReply(b"\0", 0)) == ()


def test_more_slaves_than_can_be_are_refused():
    with pytest.raises(BusError, match="65000 slaves answered"):
        drive(scan(), lambda _: DatagramReply(b"\0", 65000))


def test_a_scan_survives_lost_frames():
    line = bench_line(*[slave(f"s{n}") for n in range(4)])
    line.lose_out = lambda number: number % 7 == 3
    line.lose_back = lambda number: number % 5 == 2
    assert [each.name for each in run(line, scan())] == ["s0", "s1", "s2", "s3"]


def test_an_eeprom_that_cannot_be_read_spoils_only_its_own_slave():
    line = bench_line(slave("a"), slave("b"))
    esc = line.segment.slaves[0].esc
    esc.eeprom.image[128:132] = b"\x0a\0\xff\x0f"
    found = run(line, scan())
    assert "slave 1001: its EEPROM cannot be used" in found[0].fault
    assert (found[0].name, found[0].identity) == ("slave 1001", Identity(0, 0, 0, 0))
    assert (found[1].fault, found[1].name) == ("", "b")


def test_a_slave_that_goes_away_meanwhile_is_an_error():
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
