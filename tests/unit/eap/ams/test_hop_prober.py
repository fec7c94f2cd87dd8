from __future__ import annotations

from eap.ams.hop_prober import PROBE_PORT, HopProber
from eap.ams.record import Outcome
from eap.ams.routes import RouteTable
from eap.ams.transport_table import Forward
from eap.codec.ams import SYSTEM_PORT, AmsCommand
from eap.ids import Endpoint, NetId
from tests.support.ams import Ams, parse
from tests.support.aoerouter import (
    CLIENT,
    FAR,
    FAR_DEVICE,
    LINK,
    ROUTER,
    SECOND_LINK,
    Station,
    route,
)

SECOND = 1_000_000_000
TCP = Endpoint("tcp", "1")
ASKED = Ams(FAR_DEVICE, CLIENT)


def probing(*routes, **more) -> Station:
    return Station(routes or (route(FAR, LINK, "island"),), is_probing=True, **more)


def tick(station: Station, now_ns: int) -> tuple[list[Ams], list[tuple[Endpoint, Ams]]]:
    """Let time pass; return the probes that go out, and what is answered."""
    station.now_ns = now_ns
    probes, replies = [], []
    for action in station.router.handle_timeout(now_ns):
        packet = parse(*action.packets)
        if isinstance(action, Forward):
            assert action.ticket == 0
            probes.append(packet)
        else:
            replies.append((action.endpoint, packet))
    return probes, replies


def test_prober_reads_state_of_each_hop() -> None:
    station = probing(route(FAR, LINK), route("6.1.1.1.7.1", LINK),
                      route("7.1.1.1.1.1", SECOND_LINK), route("8.1.1.1.1.1", TCP, is_probed=False),
                      route("0.0.0.0.0.0", Endpoint("tcp", "9"), octets=0))  # fmt: skip
    assert station.router.next_timeout() == 0
    probes, _ = tick(station, 5)
    assert [each.target for each in probes] == [
        f"{FAR}:{SYSTEM_PORT}",
        f"7.1.1.1.1.1:{SYSTEM_PORT}",
    ]
    assert {each.source for each in probes} == {f"{ROUTER}:{PROBE_PORT}"}
    assert {each.command for each in probes} == {AmsCommand.READ_STATE}
    assert station.router.next_timeout() == 5 + SECOND


def test_prober_hop_is_dead_after_two_misses_until_it_answers() -> None:
    station = probing()
    ((probe,), _) = tick(station, 0)
    station.forwarded(ASKED, TCP)
    assert tick(station, SECOND) == ([probe], [])
    assert tick(station, 2 * SECOND) == ([probe], [(TCP, ASKED.answer(b"", 0x1B))])
    assert "2 probes without an answer" in station.events()[0][1]
    assert station.replied(ASKED, TCP) == (TCP, ASKED.answer(b"", 0x1B))
    assert tick(station, 3 * SECOND) == ([probe], [])
    assert station.give(probe.answer(b"", 6), LINK) == []
    assert station.forwarded(ASKED, TCP)
    assert tick(station, 4 * SECOND) == ([probe], [])
    assert tick(station, 5 * SECOND) == ([probe], [])


def test_prober_hop_dead_for_a_minute_is_gone_once() -> None:
    station = probing()
    gone = {}
    for second in range(200):
        probes, _ = tick(station, second * SECOND)
        if second == 120:
            station.give(probes[0].answer(b"", 6), LINK)
        if found := station.router.pop_gone_hops():
            gone[second] = found
    assert gone == {62: [LINK], 183: [LINK]}


def test_answers_to_requests_are_signs_of_life() -> None:
    station = probing()
    tick(station, 0)
    for number in range(1, 5):
        onward = station.forwarded(ASKED, TCP)
        station.now_ns += 1
        station.replied(onward.answer(), LINK)
        assert tick(station, number * SECOND) == ([], [])


def test_prober_busy_hop_is_probed_less_often() -> None:
    station = probing()
    tick(station, 0)
    asked = 0
    for number in range(1, 11):
        onward = station.forwarded(ASKED, TCP)
        station.now_ns += 1
        station.replied(onward.answer(), LINK)
        asked += len(tick(station, number * SECOND)[0])
    assert asked == 2


def test_prober_ignores_answer_from_another_hop() -> None:
    station = probing()
    ((probe,), _) = tick(station, 0)
    for now_ns in (SECOND, 2 * SECOND):
        tick(station, now_ns)
    assert station.give(probe.answer(), SECOND_LINK) == []
    assert station.give(probe.answer(), TCP) == []
    assert station.give(probe._replace(invoke_id=99).answer(), LINK) == []
    assert station.replied(ASKED, TCP)[1].error == 0x1B
    assert station.events()[-1][0] is Outcome.FAILED


def test_answer_by_a_broker_names_no_hop_but_the_question_does() -> None:
    station = probing(route(FAR, Endpoint("broker", FAR)))
    ((probe,), _) = tick(station, 0)
    for now_ns in (SECOND, 2 * SECOND):
        tick(station, now_ns)
    station.give(probe.answer(), Endpoint("broker", "it"))
    assert station.forwarded(ASKED, TCP)


def test_prober_pauses_for_hop_reported_down() -> None:
    for address in (LINK.connection, None):
        station = probing()
        tick(station, 0)
        station.router.hop_down("link", address, "cut", 1)
        for number in range(1, 4):
            assert tick(station, number * SECOND) == ([], [])
        station.router.hop_up("link", address)
        assert station.forwarded(ASKED, TCP)
        probes, replies = tick(station, 4 * SECOND)
        assert (len(probes), replies) == (1, [])
        assert tick(station, 5 * SECOND)[1] == []


def test_hops_come_and_go_with_the_routes() -> None:
    station = probing()
    for number in range(3):
        tick(station, number * SECOND)
    assert station.replied(ASKED, TCP)[1].error == 0x1B
    station.table.remove(NetId.parse(FAR), LINK)
    assert tick(station, 3 * SECOND) == ([], [])
    station.table.add(route(FAR, LINK))
    assert station.forwarded(ASKED, TCP)
    assert len(tick(station, 4 * SECOND)[0]) == 1
    station.table.add(route("7.1.1.1.1.1", SECOND_LINK))
    probes, _ = tick(station, 4 * SECOND + 5)
    assert [each.target for each in probes] == [f"7.1.1.1.1.1:{SYSTEM_PORT}"]


def test_prober_skips_hop_by_missing_transport() -> None:
    station = probing(route(FAR, Endpoint("nowhere", "1")))
    assert tick(station, 0) == ([], [])


def test_prober_hops_without_probes_are_alive() -> None:
    station = probing(route(FAR, LINK, is_probed=False), route("7.1.1.1.1.1", SECOND_LINK))
    tick(station, 0)
    onward = station.forwarded(ASKED, TCP)
    assert station.replied(onward.answer(), LINK) == (TCP, ASKED.answer())
    station.router.hop_up("link", "10.0.0.99")
    for number in range(1, 4):
        tick(station, number * SECOND)
    assert station.forwarded(ASKED, TCP)
    assert station.replied(ASKED._replace(target="7.1.1.1.1.1:1"), TCP)[1].error == 0x1B


def test_prober_uses_real_net_id() -> None:
    station = probing(route("10.0.0.6.1.1", LINK, real=NetId.parse(FAR)))
    assert tick(station, 0)[0][0].target == f"{FAR}:{SYSTEM_PORT}"


def test_prober_probes_router_at_the_hop() -> None:
    near = NetId.parse("6.2.2.2.1.1")
    station = probing(route(FAR, LINK, router=near))
    assert tick(station, 0)[0][0].target == f"{near}:{SYSTEM_PORT}"
    station.table.add(route(FAR, LINK))
    assert tick(station, 0)[0][0].target == f"{FAR}:{SYSTEM_PORT}"


def test_prober_probes_default_route_only_with_known_router() -> None:
    assert not tick(probing(route("0.0.0.0.0.0", LINK, octets=0)), 0)[0]
    known = probing(route("0.0.0.0.0.0", LINK, octets=0, router=NetId.parse(FAR)))
    assert tick(known, 0)[0][0].target == f"{FAR}:{SYSTEM_PORT}"


def test_prober_many_hops_are_probed_less_often() -> None:
    table = RouteTable(route(f"6.1.{n // 200}.{n % 200}.1.1", Endpoint("link", str(n)))
                       for n in range(500))  # fmt: skip
    hop_prober = HopProber(NetId.parse(ROUTER), table)
    assert len(list(hop_prober.probes_due(0))) == 500
    assert list(hop_prober.probes_due(4 * SECOND)) == []
    assert hop_prober.next_timeout() == 5 * SECOND
    assert not hop_prober.is_dead(Endpoint("link", "0"))
    assert not hop_prober.is_dead(Endpoint("link", "none"))
