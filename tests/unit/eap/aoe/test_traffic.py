from __future__ import annotations

from eap.aoe.traffic import MAX_WAYS, Traffic, TrafficTable
from eap.aoe.way import Way


def test_traffic_is_counted_by_way() -> None:
    table = TrafficTable()
    way = Way("tcp", "1")
    table.of(way).ask(44)
    table.of(way).answer(40, 1500)
    table.of(way).fail("gone")
    assert table.snapshot() == {way: Traffic(1, 1, 1, 44, 40, 1500, "gone")}
    table.of(way).ask(1)
    table.forget(way)
    assert table.snapshot() == {}


def test_snapshot_does_not_change() -> None:
    table = TrafficTable()
    way = Way("tcp", "1")
    table.of(way).ask(44)
    before = table.snapshot()
    table.of(way).ask(44)
    assert before[way].requests == 1


def test_ways_are_limited() -> None:
    table = TrafficTable()
    for number in range(MAX_WAYS + 1):
        table.of(Way("tcp", str(number)))
    assert len(table.snapshot()) == MAX_WAYS
    assert Way("tcp", "0") not in table.snapshot()
