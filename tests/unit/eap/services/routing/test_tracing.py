from __future__ import annotations

import asyncio
from itertools import count
from typing import Any

from eap.ads.endpoint import AmsAnswer
from eap.ams.spec import AccessRule
from eap.ams.spec import AccessService as Service
from eap.codec.ads import AdsError, AdsStates
from eap.codec.ams import SYSTEM_PORT
from eap.ids import NetId
from eap.services.routing.tracing import TraceResult, find_fault, trace
from tests.support.tracedplant import Line, Station, run_state, to

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
    return asyncio.run(trace(station, target, port, clock=lambda: next(ticks)))


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
    assert asyncio.run(find_fault(first, LAST, 1001)) == why
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
