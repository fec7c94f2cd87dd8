from __future__ import annotations

from eap.ads.endpoint import Endpoint
from eap.ams.record import MAX_ENDPOINTS, MAX_SOURCES, Traffic, TrafficTable
from eap.ids import NetId


def test_traffic_is_counted_by_way() -> None:
    table: TrafficTable[Endpoint] = TrafficTable()
    endpoint = Endpoint("tcp", "1")
    table.of(endpoint, 7).add_request(44)
    table.of(endpoint, 8).add_answer(40, 1500)
    table.of(endpoint, 8).add_error("gone")
    assert table.snapshot() == {endpoint: Traffic(7, 1, 1, 1, 44, 40, 1500, "gone")}
    table.of(endpoint, 9).add_request(1)
    table.forget(endpoint)
    assert table.snapshot() == {}


def test_snapshot_does_not_change() -> None:
    table: TrafficTable[Endpoint] = TrafficTable()
    endpoint = Endpoint("tcp", "1")
    table.of(endpoint, 7).add_request(44)
    before = table.snapshot()
    table.of(endpoint, 7).add_request(44)
    assert before[endpoint].requests == 1


def test_ways_are_limited() -> None:
    table: TrafficTable[Endpoint] = TrafficTable()
    for number in range(MAX_ENDPOINTS + 1):
        table.of(Endpoint("tcp", str(number)), 0)
    assert len(table.snapshot()) == MAX_ENDPOINTS
    assert Endpoint("tcp", "0") not in table.snapshot()


def test_figures_of_one_way() -> None:
    table: TrafficTable[Endpoint] = TrafficTable()
    endpoint = Endpoint("tcp", "1")
    assert table.get(endpoint) is None
    table.of(endpoint, 7).add_request(44)
    before = table.get(endpoint)
    table.of(endpoint, 8).add_answer(1, 1)
    assert before == Traffic(7, requests=1, request_bytes=44)
    after = table.get(endpoint)
    assert after is not None
    assert after.is_answered
    table.of(endpoint, 9).add_error("gone")
    assert not table.of(endpoint, 9).is_answered


def test_first_sources_are_remembered() -> None:
    traffic = Traffic()
    sources = [NetId((1, 1, 1, 1, 1, number)) for number in range(MAX_SOURCES + 1)]
    for source in (*sources, *sources):
        traffic.add_request(1, source)
    assert traffic.sources == tuple(sources[:MAX_SOURCES])
