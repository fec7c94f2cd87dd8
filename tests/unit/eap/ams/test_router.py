from __future__ import annotations

import pytest

from eap.ams.reassembly import iter_fragments
from eap.ams.record import Outcome
from eap.ams.routes import Origin
from eap.ams.transport_table import Deliver, Reply, Transport
from eap.codec.ams import AmsAnswer, AmsHeader, StateFlags, decode_packet
from eap.ids import Endpoint, NetId
from tests.support.ams import ADD_NOTIFICATION, NOTIFICATION, Ams, parse
from tests.support.aoerouter import (
    CLIENT,
    DEVICE,
    FAR,
    FAR_DEVICE,
    LINK,
    ROUTER,
    Station,
    only_reply,
    route,
)
from tests.unit.eap.ams.test_subscriptions import stream

SECOND = 1_000_000_000
TCP, UDP = Endpoint("tcp", "10.0.0.9:4711 #1"), Endpoint("segment", "02:00:00:00:00:09")
OWN = Endpoint("local", "1")


def test_router_delivers_request_and_returns_answer() -> None:
    station = Station()
    asked = Ams(DEVICE, CLIENT, invoke_id=7, body=b"request")
    delivered = station.delivered(asked, TCP)
    assert (delivered.body, delivered.endpoint) == (b"request", TCP)
    assert delivered.header.encode() + delivered.body == asked.octets()
    answer = AmsAnswer(b"data")
    back = only_reply(station.router.receive_answer(delivered.ticket, answer, 5))
    assert back == (TCP, asked.answer(b"data"))
    assert station.router.receive_answer(delivered.ticket, answer, 6) == []
    assert station.events() == []


def test_router_returns_immediate_answer() -> None:
    asked = []

    def answer_now(
        header: AmsHeader, body: bytes, endpoint: Endpoint
    ) -> tuple[AmsAnswer, int] | None:
        asked.append((header.invoke_id, body, endpoint))
        return (AmsAnswer(b"data"), 77) if body == b"known" else None

    station = Station(answer_now=answer_now)
    known = Ams(DEVICE, CLIENT, invoke_id=7, body=b"known")
    assert only_reply(station.give(known, TCP)) == (TCP, known.answer(b"data"))
    (trace,) = station.router.record.latest
    assert (trace.outcome, trace.took_ns, trace.header.invoke_id) == (Outcome.ANSWERED, 77, 7)
    other = Ams(DEVICE, CLIENT, invoke_id=8, body=b"other")
    assert station.delivered(other, TCP).body == b"other"
    station.give(known._replace(flags=6), TCP)  # wants no answer, so it is delivered
    assert [number for number, *_ in asked] == [7, 8]
    assert station.router.stats().in_flight == 1


def test_router_keeps_reason_of_a_service() -> None:
    station = Station()
    delivered = station.delivered(Ams(DEVICE, CLIENT), TCP)
    why = "0x2000:00: object does not exist (0x06020000)"
    station.router.receive_answer(delivered.ticket, AmsAnswer(b"\x0c\7\0\0", why=why), 5)
    text = f"READ of {DEVICE} for {CLIENT} ({TCP}): {why} (0x70c)"
    assert station.events() == [(Outcome.ANSWERED, text)]


def test_error_of_a_service_that_gives_no_reason_has_words() -> None:
    station = Station()
    delivered = station.delivered(Ams(DEVICE, CLIENT), TCP)
    station.router.receive_answer(delivered.ticket, AmsAnswer(error_code=4), 5)
    ((outcome, text),) = station.events()
    assert outcome is Outcome.ANSWERED
    assert text.startswith(f"READ of {DEVICE} for {CLIENT} ({TCP}): ")
    assert text.endswith(" from a service of this station")


@pytest.mark.parametrize(
    ("target", "error", "text"),
    [
        (FAR_DEVICE, 7, "no route to 6.1.1.1.1.1"),
        ("5.1.1.1.2.1:1001", 6, "nothing has port 1001 of 5.1.1.1.2.1"),
        (
            "5.1.1.1.2.1:851",
            6,
            (
                "nothing has port 851 of 5.1.1.1.2.1: it is no PLC; the variables of a station "
                "are at port 65535 of its EAP ports"
            ),
        ),
    ],
)
def test_unknown_targets_are_answered_and_named(target: str, error: int, text: str) -> None:
    station = Station()
    asked = Ams(target, CLIENT)
    assert station.replied(asked, TCP) == (TCP, asked.answer(b"", error))
    assert station.events() == [(Outcome.FAILED, f"READ of {target} for {CLIENT} ({TCP}): {text}")]


def test_default_route_takes_no_net_id_of_the_station() -> None:
    station = Station([route("0.0.0.0.0.0", LINK, octets=0)])
    assert station.forwarded(Ams("9.9.9.9.9.9:1", CLIENT), TCP).target == "9.9.9.9.9.9:1"
    asked = Ams("5.1.1.1.9.1:1", CLIENT)
    assert station.replied(asked, TCP) == (TCP, asked.answer(b"", 7))


def test_own_source_is_refused_unless_it_is_of_this_host() -> None:
    station = Station([route(FAR, LINK)])
    asked = Ams(DEVICE, f"{ROUTER}:30000")
    assert station.replied(asked, TCP) == (TCP, asked.answer(b"", 7))
    (event,) = station.events()
    assert event[0] is Outcome.LOOP
    assert "comes back to where it began" in event[1]
    assert station.delivered(asked, Endpoint("local", "1")).header.source_port == 30000
    assert station.forwarded(asked._replace(target=FAR_DEVICE), Endpoint("local", "1"))


def test_router_broadcast_is_answered_by_its_target_only() -> None:
    station = Station([route(FAR, LINK)])
    assert station.give(Ams(FAR_DEVICE, CLIENT), UDP, is_broadcast=True) == []
    assert station.give(Ams("9.9.9.9.9.9:1", CLIENT), UDP, is_broadcast=True) == []
    (delivered,) = station.give(Ams(DEVICE, CLIENT), UDP, is_broadcast=True)
    assert isinstance(delivered, Deliver)


def test_request_without_answer_gets_none() -> None:
    station = Station()
    quiet = Ams(DEVICE, CLIENT, flags=StateFlags.ADS | StateFlags.NO_RETURN)
    assert station.delivered(quiet, TCP).ticket == 0
    assert station.give(quiet._replace(target="9.9.9.9.9.9:1"), TCP) == []
    assert station.give(Ams(DEVICE, CLIENT, NOTIFICATION, body=bytes(8)), TCP) == []
    assert station.router.receive_answer(0, AmsAnswer(), 1) == []
    assert station.router.stats().in_flight == 0


def test_router_adds_and_removes_transports() -> None:
    station = Station([route(FAR, Endpoint("new", "1"))])
    assert station.replied(Ams(FAR_DEVICE, CLIENT), TCP)[1].error == 0x1B
    station.router.add_transport(Transport("new"))
    with pytest.raises(ValueError, match="exists already"):
        station.router.add_transport(Transport("new"))
    station.forwarded(Ams(FAR_DEVICE, CLIENT), TCP)
    served = station.delivered(Ams(DEVICE, CLIENT), Endpoint("new", "2"))
    assert station.router.waiting(Endpoint("new", "2")) == 1
    endpoint, answer = only_reply(station.router.remove_transport("new", 0))
    assert (endpoint, answer.error) == (TCP, 0x1B)
    assert station.router.waiting(Endpoint("new", "2")) == 0
    assert station.router.receive_answer(served.ticket, AmsAnswer(), 0) == []
    assert station.router.notify(Endpoint("new", "2"), b"packet") == []
    assert station.router.notify(TCP, b"packet") == [Reply(TCP, (b"packet",))]


def test_router_is_waiting_for_answers_and_samples_of_its_clients_only() -> None:
    station = Station([route(FAR, LINK)])

    def is_waiting_for(packet: Ams, transport: str = "link") -> bool:
        header, body = decode_packet(packet.octets())
        return station.router.is_waiting_for(header, bytes(body), transport)

    client = f"{ROUTER}:30000"  # the NetID says nothing
    onward = station.forwarded(Ams(FAR_DEVICE, client, ADD_NOTIFICATION, body=bytes(40)), OWN)
    answer = onward.answer(bytes(4) + b"\7\0\0\0")
    assert is_waiting_for(answer)
    assert not is_waiting_for(answer, "tcp")
    assert not is_waiting_for(answer._replace(invoke_id=1))
    station.give(answer, LINK)
    assert not is_waiting_for(answer)
    assert not is_waiting_for(Ams(DEVICE, CLIENT))
    notice = Ams(client, FAR_DEVICE, NOTIFICATION)
    assert is_waiting_for(notice._replace(body=stream((5, {6: b"", 7: b""}))))
    assert not is_waiting_for(notice._replace(body=stream((5, {6: b""}))))


def test_hop_that_is_down_is_known() -> None:
    station = Station()
    station.router.hop_down("link", None, "no cable", 0)
    assert station.router.is_down(LINK)
    station.router.hop_up("link", None)
    assert not station.router.is_down(LINK)


def test_router_drops_malformed_packets_with_reason() -> None:
    station = Station()
    octets = Ams(DEVICE, CLIENT, body=b"abc").octets()
    for broken in (b"", octets[:31], octets[:-1]):
        assert station.router.receive_packet(broken, "tcp", "1", 0) == []
    events = station.events()
    assert [outcome for outcome, _ in events] == [Outcome.DROPPED] * 3
    assert "length 3, but 2 bytes follow" in events[2][1]


def test_surplus_octets_go_no_further() -> None:
    station = Station([route(FAR, LINK)])
    octets = Ams(FAR_DEVICE, CLIENT, body=b"abc").octets() + b"more"
    (forward,) = station.router.receive_packet(octets, "tcp", "1", 0)
    assert parse(*forward.packets).body == b"abc"


def test_router_reassembles_and_sends_fragments() -> None:
    station = Station()
    narrow = Endpoint("narrow", "1")
    asked = Ams(DEVICE, CLIENT, invoke_id=9, body=bytes(range(90)))
    *before, last = iter_fragments(asked.octets(), 4, 28)
    for each in before:
        assert station.router.receive_packet(each, *narrow, 0) == []
    (delivered,) = station.router.receive_packet(last, *narrow, 0)
    assert delivered.body == asked.body
    (reply,) = station.router.receive_answer(delivered.ticket, AmsAnswer(bytes(80)), 0)
    client = Station([route(FAR, LINK)])
    whole = [client.router.receive_packet(each, *TCP, 0) for each in reply.packets]
    assert len(whole) == 4
    assert "no request waits for" in client.events()[0][1]  # it was put together: an answer


def test_router_acknowledges_fragments_on_request() -> None:
    station = Station()
    first = parse(next(iter_fragments(Ams(DEVICE, CLIENT, body=bytes(50)).octets(), 4, 28)))
    wanting = first._replace(flags=StateFlags.ADS)
    assert station.replied(wanting, UDP) == (UDP, wanting.answer(b""))
    assert station.give(wanting, UDP, is_broadcast=True) == []
    assert station.give(wanting.answer(b""), UDP) == []
    assert station.router.stats().fragment_octets == 28
    station.router.connection_closed(*UDP, 0)
    assert station.router.stats().fragment_octets == 0


def test_fragments_in_fragments_are_dropped() -> None:
    station = Station()
    inner = next(iter_fragments(Ams(DEVICE, CLIENT, body=bytes(50)).octets(), 4, 28))
    for each in iter_fragments(inner, 5, 28):
        assert station.router.receive_packet(each, *TCP, 0) == []
    assert "a fragment in fragments" in station.events()[-1][1]


def test_time_of_routes_and_requests_is_one() -> None:
    station = Station([route(FAR, LINK, origin=Origin.LEARNED, expires_at_ns=50)])
    assert station.router.next_timeout() == 50
    asked = Ams(FAR_DEVICE, CLIENT)
    station.forwarded(asked, TCP)
    assert station.router.handle_timeout(50) == []
    assert station.replied(asked, TCP) == (TCP, asked.answer(b"", 7))
    assert station.router.next_timeout() == 4_500_000_000
    assert station.router.stats().routes == 0


def test_router_counts_packets() -> None:
    station = Station([route(FAR, LINK)])
    asked = Ams(FAR_DEVICE, CLIENT, body=b"12")
    onward = station.forwarded(asked, TCP)
    station.now_ns = 700
    (reply,) = station.give(onward.answer(b"1234"), LINK)
    assert isinstance(reply, Reply)
    (client,) = station.router.connections()
    hop = station.router.report(*station.table)
    assert (client.endpoint, hop.route.hop) == (TCP, LINK)
    assert client.traffic.sources == (NetId.parse(CLIENT.partition(":")[0]),)
    for traffic in (client.traffic, hop.traffic):
        assert (traffic.requests, traffic.answers, traffic.errors) == (1, 1, 0)
        assert (traffic.request_bytes, traffic.answer_bytes) == (34, 36)
        assert traffic.round_trip_ns == 700
    assert station.router.stats().counts[Outcome.ANSWERED] == 1
    assert station.router.record.latest[-1].took_ns == 700
    station.router.connection_closed(*TCP, 800)
    assert station.router.connections() == []
