"""Traces, counters and traffic of a router."""

from __future__ import annotations

from msgspec.structs import replace

from eap.ams.record import (
    MAX_ENDPOINTS,
    MAX_EVENTS,
    MAX_LATEST,
    MAX_SOURCES,
    Outcome,
    Record,
    Trace,
    Traffic,
    TrafficTable,
    describe,
)
from eap.codec.ams import AmsHeader
from eap.ids import Endpoint, NetId


def test_traffic_is_counted_by_endpoint() -> None:
    table: TrafficTable[Endpoint] = TrafficTable()
    endpoint = Endpoint("tcp", "1")
    table.of(endpoint, 7).add_request(44)
    table.of(endpoint, 8).add_answer(40, 1500)
    table.of(endpoint, 8).add_error("gone", 8)
    assert table.snapshot() == {
        endpoint: Traffic(7, 1, 1, 1, 44, 40, 1500, "gone", last_error_ns=8)
    }
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


def test_endpoints_are_limited() -> None:
    table: TrafficTable[Endpoint] = TrafficTable()
    for number in range(MAX_ENDPOINTS + 1):
        table.of(Endpoint("tcp", str(number)), 0)
    assert len(table.snapshot()) == MAX_ENDPOINTS
    assert Endpoint("tcp", "0") not in table.snapshot()


def test_traffic_of_one_endpoint() -> None:
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
    table.of(endpoint, 9).add_error("gone", 8)
    assert not table.of(endpoint, 9).is_answered


def test_first_sources_are_remembered() -> None:
    traffic = Traffic()
    sources = [NetId((1, 1, 1, 1, 1, number)) for number in range(MAX_SOURCES + 1)]
    for source in (*sources, *sources):
        traffic.add_request(1, source)
    assert traffic.sources == tuple(sources[:MAX_SOURCES])


def trace(at_ns: int, outcome: Outcome = Outcome.FAILED, error: int = 7, text: str = "") -> Trace:
    return Trace(at_ns, outcome, None, None, None, error, 0, text)


def test_record_answered_request_is_no_event() -> None:
    record = Record()
    record.add(trace(1, Outcome.ANSWERED, 0))
    record.add(trace(2, Outcome.ANSWERED, 6))
    record.add(trace(3))
    record.add(trace(4, Outcome.ANSWERED, 0, "0x2000:00: object does not exist"))
    assert [each.at_ns for each in iter(record.next_event, None)] == [2, 3, 4]
    assert [each.at_ns for each in record.latest] == [1, 2, 3, 4]
    assert (record.counts[Outcome.ANSWERED], record.counts[Outcome.FAILED]) == (3, 1)


def test_answers_to_probes_are_counted_only() -> None:
    record = Record()
    probe = AmsHeader(NetId.parse("5.1.1.1.1.1"), 10000, NetId.parse("6.1.1.1.1.1"), 1, 4)
    alive = replace(trace(1, Outcome.ANSWERED, 0), header=probe)
    record.add(alive)
    record.add(replace(alive, error_code=6))
    assert [each.error_code for each in record.latest] == [6]
    assert record.counts[Outcome.ANSWERED] == 2


def test_record_counts_an_answered_request_before_anything_is_read() -> None:
    endpoint, hop = Endpoint("tcp", "1"), Endpoint("link", "2")
    key = NetId.parse("5.1.1.1.1.1"), hop
    for read in (
        lambda record: record.connections.snapshot()[endpoint].answers,
        lambda record: record.routes.snapshot()[key].answers,
        lambda record: record.counts[Outcome.ANSWERED],
        lambda record: len(record.latest),
    ):
        record = Record()
        for number in (1, 2):
            answered = Trace(number, Outcome.ANSWERED, endpoint, hop, None, 0, 5, "")
            record.add_answered(answered, endpoint, key, 40)
        assert read(record) == 2
        record.settle()
        assert read(record) == 2, "counted once"
        assert not record.has_events


def test_record_counts_noted_requests_before_anything_is_read() -> None:
    source = NetId.parse("5.1.1.1.1.1")
    endpoint, key = Endpoint("tcp", "1"), (source, Endpoint("link", "2"))
    record = Record()
    for number in (1, 2):
        record.add_request(endpoint, 44, source, number)
        record.add_forwarded(key, 40, number)
    expected = Traffic(1, requests=2, request_bytes=88, sources=(source,))
    assert record.connections.snapshot() == {endpoint: expected}
    assert record.routes.snapshot() == {key: Traffic(1, requests=2, request_bytes=80)}
    record.settle()
    assert record.connections.snapshot() == {endpoint: expected}, "counted once"


def test_record_keeps_the_order_of_traces() -> None:
    record = Record()
    endpoint = Endpoint("tcp", "1")
    record.add_answered(
        Trace(1, Outcome.ANSWERED, endpoint, None, None, 0, 5, ""), endpoint, None, 40
    )
    record.add(trace(2))
    assert [each.at_ns for each in record.latest] == [1, 2]


def test_record_of_a_forgotten_connection_stays_forgotten() -> None:
    record = Record()
    endpoint = Endpoint("tcp", "1")
    record.add_answered(
        Trace(1, Outcome.ANSWERED, endpoint, None, None, 0, 5, ""), endpoint, None, 40
    )
    record.connections.forget(endpoint)
    assert record.connections.snapshot() == {}


def test_traces_are_limited() -> None:
    record = Record()
    for number in range(MAX_EVENTS + 3):
        record.add(trace(number))
    assert record.next_event() == trace(3)
    assert len(record.latest) == MAX_LATEST


def test_requests_are_described_for_people() -> None:
    header = AmsHeader(NetId.parse("5.1.1.1.1.1"), 851, NetId.parse("6.1.1.1.1.1"), 3000, 2)
    assert describe(header) == "READ of 5.1.1.1.1.1:851 for 6.1.1.1.1.1:3000"
    assert describe(header, Endpoint("tcp", "x")).endswith("3000 (x by tcp)")
