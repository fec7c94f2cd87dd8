from __future__ import annotations

from eap.ams.endpoint import Way
from eap.ams.traffic import MAX_SOURCES, MAX_WAYS, Traffic, TrafficTable
from eap.ids import NetId


def test_traffic_is_counted_by_way() -> None:
    table: TrafficTable[Way] = TrafficTable()
    way = Way("tcp", "1")
    table.of(way, 7).ask(44)
    table.of(way, 8).answer(40, 1500)
    table.of(way, 8).fail("gone")
    assert table.snapshot() == {way: Traffic(7, 1, 1, 1, 44, 40, 1500, "gone")}
    table.of(way, 9).ask(1)
    table.forget(way)
    assert table.snapshot() == {}


def test_snapshot_does_not_change() -> None:
    table: TrafficTable[Way] = TrafficTable()
    way = Way("tcp", "1")
    table.of(way, 7).ask(44)
    before = table.snapshot()
    table.of(way, 7).ask(44)
    assert before[way].requests == 1


def test_ways_are_limited() -> None:
    table: TrafficTable[Way] = TrafficTable()
    for number in range(MAX_WAYS + 1):
        table.of(Way("tcp", str(number)), 0)
    assert len(table.snapshot()) == MAX_WAYS
    assert Way("tcp", "0") not in table.snapshot()


def test_figures_of_one_way() -> None:
    table: TrafficTable[Way] = TrafficTable()
    way = Way("tcp", "1")
    assert table.get(way) is None
    table.of(way, 7).ask(44)
    before = table.get(way)
    table.of(way, 8).answer(1, 1)
    assert before == Traffic(7, requests=1, octets_asked=44)
    after = table.get(way)
    assert after is not None
    assert after.is_answered
    table.of(way, 9).fail("gone")
    assert not table.of(way, 9).is_answered


def test_first_sources_are_remembered() -> None:
    traffic = Traffic()
    sources = [NetId((1, 1, 1, 1, 1, number)) for number in range(MAX_SOURCES + 1)]
    for source in (*sources, *sources):
        traffic.ask(1, source)
    assert traffic.sources == tuple(sources[:MAX_SOURCES])
