"""Traces, hop queries and route tests."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from itertools import count
from time import monotonic_ns
from typing import Any

import pytest

from eap.ads.request import Operation, Read, ReadState, ReadWrite, decode_outcome, encode_query
from eap.ams.directory import AmsAddress
from eap.ams.record import Outcome, Trace, describe
from eap.ams.report import HopQuestion, decode_report
from eap.ams.routes import Route
from eap.ams.spec import AccessRule
from eap.ams.spec import AccessService as Service
from eap.codec.ads import AdsError, AdsStates, IndexGroup
from eap.codec.ams import SYSTEM_PORT, AmsAnswer, AmsHeader
from eap.errors import ControlError
from eap.ids import Endpoint, NetId
from eap.services.routing import tracing
from eap.services.routing.service import LocalRequest
from eap.services.routing.tracing import (
    RouteQuery,
    TraceResult,
    find_fault,
    find_target,
    probe_target,
    trace,
)
from tests.support.ams import Ams
from tests.support.eventually import settle
from tests.support.routeviews import DIRECTORY, Left
from tests.support.routing import while_serving
from tests.support.tracedplant import Line, Station, run_state, to
from tests.support.virtualtime import run_virtual

FAR = NetId.parse("5.1.1.3.3.1")


def line_of_three() -> tuple[Line, Station]:
    """Three stations in a row; each knows its neighbours, and who is beyond them."""
    line = Line()
    first = line.add(1, to(2), to(3, 2))
    line.add(2, to(1), to(3))
    line.add(3, to(1, 2), to(2))
    return line, first


def follow(station: Station, target: NetId = FAR, port: int = 1001) -> TraceResult:
    ticks = count(0, 1000)
    return run_virtual(trace(station, target, port, clock=lambda: next(ticks)))


def names(traced: TraceResult) -> list[str]:
    return [each.report.station for each in traced.hops]


def test_trace_lists_every_router_with_its_next_hop() -> None:
    _, first = line_of_three()
    traced = follow(first)
    assert names(traced) == ["island-01", "island-02", "island-03"]
    assert [each.report.route for each in traced.hops] == ["island-03", "island-03", ""]
    assert [each.took_ns for each in traced.hops] == [1000, 1000, 1000]
    assert (traced.why, traced.took_ns) == ("", 1000)
    assert traced.states == AdsStates(5, 8)


def test_routers_need_routes_to_their_neighbours_only() -> None:
    line = Line()
    first = line.add(1, to(2), to(4, 2))
    line.add(2, to(3), to(4, 3))
    line.add(3, to(4))
    line.add(4)
    traced = follow(first, NetId.parse("5.1.1.4.3.1"))
    assert names(traced) == ["island-01", "island-02", "island-03", "island-04"]
    assert not traced.why


def test_trace_local_target_has_one_hop() -> None:
    _, first = line_of_three()
    traced = follow(first, NetId.parse("5.1.1.1.3.1"))
    assert names(traced) == ["island-01"]
    assert traced.states is not None


def test_trace_of_a_missing_slave_fails_although_its_master_answers() -> None:
    line = Line()
    first = line.add(1, to(2))
    line.add(2, to(1), serve=lambda *_: AmsAnswer(bytes(8)))
    traced = follow(first, NetId.parse("5.1.1.2.3.1"))
    assert traced.why == "island-02: its master answers: the slave does not answer"
    assert traced.states == AdsStates(0, 0)
    assert not follow(first, NetId.parse("5.1.1.2.3.1"), 0xFFFF).why  # the master itself


def test_trace_reports_the_faults_of_the_slave_and_of_its_bus() -> None:
    line = Line()
    first = line.add(1, to(2))
    last = line.add(2, to(1), serve=lambda *_: AmsAnswer(bytes(8)))
    target = NetId.parse("5.1.1.2.3.1")
    last.faults[target, 1001] = ("bus0: no frame comes back; check the cable",)
    dead = follow(first, target)
    assert dead.why == (
        "island-02: its master answers: the slave does not answer;"
        " bus0: no frame comes back; check the cable"
    )
    last.serve = run_state
    alive = follow(first, target)
    assert not alive.why
    assert [each.report.faults for each in alive.hops] == [(), last.faults[target, 1001]]
    assert [each.report.faults for each in follow(first, target, 0xFFFF).hops] == [(), ()]


def test_trace_carries_the_reason_that_the_last_router_logged() -> None:
    line = Line()
    first = line.add(1, to(2))
    last = line.add(2, to(1))
    target = NetId.parse("5.1.1.2.3.1")

    def fail(port: int, command: int, body: bytes) -> AmsAnswer:
        header = AmsHeader(target, port, NetId.parse("9.9.9.9.1.1"), 1, command)
        text = f"{describe(header)}: the engine does not answer"
        at_ns = monotonic_ns()
        last.record.add(Trace(at_ns, Outcome.ANSWERED, None, None, header, 0x1B, 0, text))
        return AmsAnswer(error_code=AdsError.HOST_UNREACHABLE)

    last.serve = fail
    assert follow(first, target).why == "island-02: the engine does not answer (0x1b)"
    last.record.latest.clear()
    last.serve = lambda *_: AmsAnswer(error_code=AdsError.HOST_UNREACHABLE)
    assert follow(first, target).why == "island-02: error 0x1b (host unreachable)"


def test_trace_names_a_dead_hop_and_the_router_before_it() -> None:
    line, first = line_of_three()
    line.dead.add("island-03")
    traced = follow(first)
    assert names(traced) == ["island-01", "island-02", "island-03"]
    assert [each.is_opaque for each in traced.hops] == [False, False, True]
    assert traced.answer is None
    assert traced.why == (
        "island-03: it does not answer island-02 at island-03 by link:"
        " error 0x719 (no answer in time)"
    )


def test_a_link_that_a_router_knows_to_be_down() -> None:
    line, first = line_of_three()
    line.stations["island-02"].router.hop_down("link", "island-03", "cable pulled", 1)
    traced = follow(first)
    assert names(traced) == ["island-01", "island-02"]
    assert traced.why == "island-02: island-03 (island-03 by link) is down: cable pulled"


def line_of_four() -> tuple[Line, Station]:
    """Four stations in a row."""
    line = Line()
    first = line.add(1, to(2), to(3, 2), to(4, 2))
    line.add(2, to(1), to(3), to(4, 3))
    line.add(3, to(1, 2), to(2), to(4))
    line.add(4, to(1, 3), to(2, 3), to(3))
    return line, first


LAST = NetId.parse("5.1.1.4.3.1")


def test_trace_several_dead_stations_names_the_first() -> None:
    line, first = line_of_four()
    line.dead |= {"island-02", "island-03", "island-04"}
    silent = "it does not answer island-01 at island-02 by link: error 0x719 (no answer in time)"
    assert follow(first, LAST).why == f"island-02: {silent}"
    assert names(follow(first, LAST)) == ["island-01", "island-02"]
    line.dead.remove("island-02")
    assert follow(first, LAST).why.startswith("island-03: it does not answer island-02 at ")


def test_trace_several_stations_known_to_be_dead_names_the_first() -> None:
    line, first = line_of_four()
    line.dead |= {"island-03", "island-04"}
    line.stations["island-02"].router.hop_down("link", "island-03", "it does not answer", 1)
    why = "island-02: island-03 (island-03 by link) is down: it does not answer"
    assert follow(first, LAST).why == why
    assert run_virtual(find_fault(first, LAST, 1001)) == why
    line.dead.add("island-02")
    first.router.hop_down("link", "island-02", "it does not answer", 1)
    why = "island-01: island-02 (island-02 by link) is down: it does not answer"
    assert follow(first, LAST).why == why


def test_trace_hop_lost_meanwhile_is_named_and_is_no_loop() -> None:
    line, first = line_of_three()
    second = line.stations["island-02"]
    request, sent = first.request, count()

    async def request_while_hop_is_lost(*words: Any, **more: float) -> AmsAnswer:
        if next(sent):
            second.router.hop_down("link", "island-03", "it does not answer", 1)
        return await request(*words, **more)

    first.request = request_while_hop_is_lost  # type: ignore[method-assign]
    traced = follow(first)
    assert names(traced) == ["island-01", "island-02"]
    assert traced.hops[-1].report.state == "down"
    assert traced.why == "island-02: island-03 (island-03 by link) is down: it does not answer"


def test_a_missing_route_and_a_missing_port() -> None:
    _, first = line_of_three()
    assert follow(first, NetId.parse("7.7.7.7.1.1")).why == ("island-01: no route to 7.7.7.7.1.1")
    missing = follow(first, port=1009)
    assert missing.why == "island-03: nothing has port 1009 of 5.1.1.3.3.1"


def test_trace_names_a_loop() -> None:
    line = Line()
    first = line.add(1, to(2), to(9, 2))
    line.add(2, to(3), to(9, 3))
    line.add(3, to(1), to(9, 1))
    traced = follow(first, NetId.parse("5.1.1.9.3.1"))
    assert names(traced) == ["island-01", "island-02", "island-03"]
    assert traced.why == "island-01: the routes run in a circle; it is on the path already"


def test_trace_router_of_another_make_is_opaque_and_target_is_read() -> None:
    line, first = line_of_three()
    line.stations["island-02"].is_ours = False
    traced = follow(first)
    assert names(traced) == ["island-01", "island-02"]
    assert traced.hops[1].is_opaque
    assert traced.hops[1].report.net_id == "5.1.1.2.1.1"
    assert not traced.why
    assert traced.states is not None


def test_trace_silent_router_may_forward_requests() -> None:
    line, first = line_of_three()
    line.stations["island-03"].is_ours = False
    line.stations["island-03"].serve = silent_router
    traced = follow(first)
    assert [each.is_opaque for each in traced.hops] == [False, False, True]
    assert not traced.why
    assert traced.states is not None


def silent_router(port: int, command: int, body: bytes) -> AmsAnswer:
    if port == SYSTEM_PORT:
        return AmsAnswer(error_code=AdsError.TIMEOUT)
    return run_state(port, command, body)


def test_trace_names_access_rules_that_deny_the_query() -> None:
    line = Line()
    first = line.add(1, to(2))
    closed = AccessRule("closed", allow=False)
    line.add(2, to(1), rules=[closed])
    target = NetId.parse("5.1.1.2.3.1")
    (_, second) = follow(first, target).hops
    assert second.report.may[Service.READ] is False
    allowed = follow(line.add(3, to(2)), target).hops[0].report.may
    assert allowed[Service.WRITE] is True, "whoever traces is this host at the first router"


def test_virtual_net_ids_are_followed() -> None:
    line = Line()
    real = NetId.parse("5.1.1.2.1.1")
    virtual = to(2)
    virtual = type(virtual)(
        NetId.parse("10.2.2.2.1.1"), "island-02", virtual.hop, real=real, router=real
    )
    first = line.add(1, virtual)
    line.add(2)
    traced = follow(first, NetId.parse("10.2.2.2.3.1"))
    assert names(traced) == ["island-01", "island-02"]


WAY = Endpoint("link", "island-09")
TARGET = NetId.parse("5.1.1.2.3.1")
G = IndexGroup


class Rest:
    """Service behind: it records that it was called."""

    ports = frozenset((10_000,))

    def __init__(self) -> None:
        self.gone: list[Endpoint] = []

    def answer(self, request: LocalRequest) -> AmsAnswer:
        return AmsAnswer(b"rest" + bytes((request.header.command,)))

    def client_gone(self, endpoint: Endpoint) -> None:
        self.gone.append(endpoint)


def service(rest: Rest) -> RouteQuery:
    line = Line()
    station = line.add(1, to(2))
    line.add(2)
    return RouteQuery(station, rest)


def ask(operation: Operation) -> AmsAnswer:
    command, body = encode_query(operation)
    header = AmsHeader(NetId.parse("5.1.1.1.1.1"), 10_000, NetId.parse("9.9.9.9.1.1"), 1, command)

    async def get() -> AmsAnswer:
        answer = service(Rest()).answer(LocalRequest(header, body, WAY))
        return await answer if isinstance(answer, Awaitable) else answer

    return run_virtual(get())


@pytest.mark.parametrize(("further", "station"), [(0, "island-01"), (1, "island-02")])
def test_hop_query_is_answered_or_forwarded(further: int, station: str) -> None:
    question = HopQuestion(TARGET, 1001, further)
    answer = ask(ReadWrite(G.ROUTE_QUERY, 0, 4096, question.encode()))
    outcome = decode_outcome(9, answer.error_code, answer.data)
    assert decode_report(outcome.data).station == station


@pytest.mark.parametrize(
    "operation",
    [
        ReadWrite(G.ROUTE_QUERY, 0, 4096, b"\5\1"),
        ReadWrite(G.ROUTE_QUERY, 0, 10, HopQuestion(TARGET, 1001).encode()),
    ],
)
def test_hop_query_of_wrong_size_is_an_error(operation: Operation) -> None:
    assert ask(operation).data == bytes.fromhex("05070000 00000000")


@pytest.mark.parametrize(
    "operation", [ReadState(), Read(G.ROUTE_QUERY, 0, 4), ReadWrite(G.SYMBOL_HANDLE, 0, 4, b"x")]
)
def test_other_requests_go_to_the_system_service(operation: Operation) -> None:
    assert ask(operation).data.startswith(b"rest")


def test_ports_and_clients_are_those_of_the_system_service() -> None:
    rest = Rest()
    here = service(rest)
    assert here.ports is rest.ports
    here.client_gone(WAY)
    assert rest.gone == [WAY]


BEYOND = Route(
    NetId.parse("127.0.9.3.1.1"), "third", Endpoint("udp:eap0", "127.0.9.2:34980"),
    router=NetId.parse("127.0.9.2.1.1"),
)  # fmt: skip
RIGHT = AmsAddress(NetId.parse("127.0.9.2.1.1"), 10000)


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("right", "127.0.9.2.1.1:10000"),
        ("left", "127.0.9.1.1.1:10000"),
        ("right/eap0", "127.0.9.2.2.1:65535"),
        ("9.9.9.9.1.1", "9.9.9.9.1.1:10000"),
        ("9.9.9.9.1.1:851", "9.9.9.9.1.1:851"),
    ],
)
def test_trace_finds_targets_by_name(text: str, address: str) -> None:
    assert str(find_target(Left().router, DIRECTORY, text)) == address


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("rihgt", "no station 'rihgt' in this plant, did you mean right.*nor is there a route"),
        ("1.2.3.4.5.600", "has a number above 255"),
    ],
)
def test_find_target_rejects_unknown_names(text: str, reason: str) -> None:
    with pytest.raises(ControlError, match=reason):
        find_target(Left().router, DIRECTORY, text)


def probe(
    target: AmsAddress, *, data: bytes | None = None, error: int = 0, down: str = "",
    more: Route | None = None,
):  # fmt: skip
    """Ask *target*; the hop answers with *data* or *error*, if with either."""
    left = Left()
    if more is not None:
        left.router.add_route(more)

    async def script():
        if down:
            left.router.hop_down("udp:eap0", None, down)
        task = asyncio.ensure_future(probe_target(left.router, target, 0.2))
        await settle()
        if data is not None:
            for endpoint, packet in list(left.sender.sent):
                answer: Ams = packet.answer(data, error)
                left.router.receive(answer.octets(), "udp:eap0", endpoint)
        return await task

    return run_virtual(while_serving(script(), left.router))


def test_probe_reports_round_trip_and_state() -> None:
    found = probe(RIGHT, data=bytes.fromhex("00000000 0500 0000"))
    assert (found.ok, found.text, found.state, found.name) == (
        True, "answers: RUN", "RUN", "right"
    )  # fmt: skip
    assert 0 < found.rtt_us < 200_000
    assert (found.target, found.hint, found.error) == ("127.0.9.2.1.1:10000", "", 0)


@pytest.mark.parametrize(
    ("data", "text"),
    [("00000000 6300 0000", "answers: state 99"), ("01070000", "answers")],
)
def test_odd_answers_are_answers(data: str, text: str) -> None:
    found = probe(RIGHT, data=bytes.fromhex(data))
    assert (found.ok, found.text) == (True, text)


def test_probe_reports_errors_with_a_hint() -> None:
    found = probe(RIGHT, data=b"", error=7)
    assert (found.ok, found.rtt_us, found.error) == (False, None, 7)
    assert "has no route to 127.0.9.2.1.1" in found.text
    assert "needs a route" in found.hint
    found = probe(RIGHT, down="no carrier")
    assert found.text == "right (127.0.9.2:34980 by udp:eap0) is down: no carrier"
    found = probe(AmsAddress(NetId.parse("9.9.9.9.1.1"), 10000))
    assert found.text == "there is no route to 9.9.9.9.1.1"
    assert "eapctl routes add" in found.hint


def test_probe_of_a_missing_slave_fails() -> None:
    found = probe(RIGHT._replace(port=1003), data=bytes(8))
    assert (found.ok, found.text) == (False, "its master answers: the slave does not answer")
    assert probe(RIGHT, data=bytes(8)).ok  # of a router it says nothing about a slave


def test_request_beyond_a_dead_router_names_the_router() -> None:
    left = Left()
    left.router.add_route(BEYOND)
    target = AmsAddress(NetId.parse("127.0.9.3.1.1"), 10000)
    ask = probe_target(left.router, target, 0.2)
    left.router.hop_down("udp:eap0", "127.0.9.2:34980", "it does not answer")
    found = run_virtual(while_serving(ask, left.router))
    text = "right (127.0.9.2:34980 by udp:eap0) is down: it does not answer"
    assert (found.name, found.text) == ("third", text)


def test_request_beyond_a_router_that_finds_a_fault_names_it(monkeypatch) -> None:
    async def find(router, *address):
        assert (router.name, str(AmsAddress(*address))) == ("left", "127.0.9.3.1.1:10000")
        return why

    monkeypatch.setattr(tracing, "find_fault", find)
    target = AmsAddress(NetId.parse("127.0.9.3.1.1"), 10000)
    why = "right: third (127.0.9.3:34980 by udp:eap1) is down: it does not answer"
    assert probe(target, data=b"", error=0x1B, more=BEYOND).text == why
    why = ""
    assert "host unreachable behind right" in probe(target, data=b"", error=0x1B, more=BEYOND).text
    assert probe(RIGHT, data=b"", error=0x1B).text.startswith("host unreachable behind right")


def test_probe_limits_the_time_of_the_fault_search(monkeypatch) -> None:
    async def find(router, *address):
        await asyncio.Event().wait()

    monkeypatch.setattr(tracing, "find_fault", find)
    monkeypatch.setattr(tracing, "FAULT_SEARCH_S", 0.01)
    target = AmsAddress(NetId.parse("127.0.9.3.1.1"), 10000)
    assert "no answer from right" in probe(target, more=BEYOND).text


def test_probe_reports_a_time_out() -> None:
    found = probe(RIGHT)
    assert found.error == 0x719
    assert "no answer from right" in found.text


def test_station_itself_answers_without_a_route() -> None:
    found = probe(AmsAddress(NetId.parse("127.0.9.1.1.1"), 10000))
    assert (found.ok, found.name, found.state) == (True, "", "RUN")
    found = probe(AmsAddress(NetId.parse("127.0.9.1.2.1"), 4))
    assert found.ok  # nothing has the port, and only the station can say so
