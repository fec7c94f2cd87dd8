from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from eap.aoe.action import Action, Deliver, Forward, Outcome, Reply
from eap.aoe.answer import AmsAnswer
from eap.aoe.fragment import Assembler, iter_fragments
from eap.aoe.judge import Limits
from eap.aoe.routes import Origin
from eap.aoe.way import Door, Way
from eap.codec.ams import AmsHeader, StateFlags, decode_packet
from eap.ids import NetId
from tests.support.ams import ADD_NOTIFICATION, NOTIFICATION, Ams, parse
from tests.support.aoerouter import (
    CLIENT,
    DEVICE,
    FAR,
    FAR_DEVICE,
    LINK,
    ROUTER,
    SECOND_LINK,
    Station,
    only_reply,
    route,
)
from tests.unit.eap.aoe.test_subscriptions import stream

SECOND = 1_000_000_000
TCP, UDP = Way("tcp", "10.0.0.9:4711 #1"), Way("segment", "02:00:00:00:00:09")


def test_service_of_the_station_is_asked_and_its_answer_goes_back() -> None:
    station = Station()
    asked = Ams(DEVICE, CLIENT, invoke_id=7, body=b"request")
    delivered = station.delivered(asked, TCP)
    assert (delivered.body, delivered.came_by) == (b"request", TCP)
    assert delivered.header.encode() + delivered.body == asked.octets()
    answer = AmsAnswer(b"data")
    back = only_reply(station.router.receive_answer(delivered.ticket, answer, 5))
    assert back == (TCP, asked.answer(b"data"))
    assert station.router.receive_answer(delivered.ticket, answer, 6) == []
    assert station.events() == []


def test_what_is_at_hand_goes_back_at_once() -> None:
    asked = []

    def answer_now(header: AmsHeader, body: bytes, way: Way) -> tuple[AmsAnswer, int] | None:
        asked.append((header.invoke_id, body, way))
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


def test_what_a_service_says_of_a_refusal_is_kept() -> None:
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
    assert station.delivered(asked, Way("local", "1")).header.source_port == 30000
    assert station.forwarded(asked._replace(target=FAR_DEVICE), Way("local", "1"))


def test_what_came_by_multicast_is_for_who_is_meant() -> None:
    station = Station([route(FAR, LINK)])
    assert station.give(Ams(FAR_DEVICE, CLIENT), UDP, for_all=True) == []
    assert station.give(Ams("9.9.9.9.9.9:1", CLIENT), UDP, for_all=True) == []
    (delivered,) = station.give(Ams(DEVICE, CLIENT), UDP, for_all=True)
    assert isinstance(delivered, Deliver)


def test_request_without_answer_gets_none() -> None:
    station = Station()
    quiet = Ams(DEVICE, CLIENT, flags=StateFlags.ADS | StateFlags.NO_RETURN)
    assert station.delivered(quiet, TCP).ticket == 0
    assert station.give(quiet._replace(target="9.9.9.9.9.9:1"), TCP) == []
    assert station.delivered(Ams(DEVICE, CLIENT, NOTIFICATION, body=bytes(8)), TCP).ticket == 0
    assert station.router.receive_answer(0, AmsAnswer(), 1) == []
    assert station.router.stats().in_flight == 0


def test_doors_come_and_go() -> None:
    station = Station([route(FAR, Way("new", "1"))])
    assert station.replied(Ams(FAR_DEVICE, CLIENT), TCP)[1].error == 0x1B
    station.router.add_door(Door("new"))
    with pytest.raises(ValueError, match="two doors"):
        station.router.add_door(Door("new"))
    station.forwarded(Ams(FAR_DEVICE, CLIENT), TCP)
    served = station.delivered(Ams(DEVICE, CLIENT), Way("new", "2"))
    assert station.router.waiting(Way("new", "2")) == 1
    way, answer = only_reply(station.router.remove_door("new", 0))
    assert (way, answer.error) == (TCP, 0x1B)
    assert station.router.waiting(Way("new", "2")) == 0
    assert station.router.receive_answer(served.ticket, AmsAnswer(), 0) == []
    assert station.router.notify(Way("new", "2"), b"packet") == []
    assert station.router.notify(TCP, b"packet") == [Reply(TCP, (b"packet",))]


def test_what_is_expected_is_for_here_or_for_who_waits_here() -> None:
    station = Station([route(FAR, LINK)])

    def expects(packet: Ams, door: str = "link") -> bool:
        header, body = decode_packet(packet.octets())
        return station.router.expects(header, bytes(body), door)

    onward = station.forwarded(Ams(FAR_DEVICE, CLIENT, ADD_NOTIFICATION, body=bytes(40)), TCP)
    answer = onward.answer(bytes(4) + b"\7\0\0\0")
    assert expects(answer)
    assert not expects(answer, "tcp")
    assert not expects(answer._replace(invoke_id=1))
    station.give(answer, LINK)
    assert not expects(answer)
    assert expects(Ams(DEVICE, CLIENT))
    assert not expects(Ams(FAR_DEVICE, CLIENT))
    notice = Ams(CLIENT, FAR_DEVICE, NOTIFICATION)
    assert expects(notice._replace(body=stream((5, {6: b"", 7: b""}))))
    assert not expects(notice._replace(body=stream((5, {6: b""}))))


def test_hop_that_is_down_is_known() -> None:
    station = Station()
    station.router.hop_down("link", None, "no cable", 0)
    assert station.router.is_down(LINK)
    station.router.hop_up("link", None)
    assert not station.router.is_down(LINK)


def test_broken_packets_are_named_and_answered_by_nobody() -> None:
    station = Station()
    octets = Ams(DEVICE, CLIENT, body=b"abc").octets()
    for broken in (b"", octets[:31], octets[:-1]):
        assert station.router.receive_packet(broken, "tcp", "1", 0) == []
    events = station.events()
    assert [outcome for outcome, _ in events] == [Outcome.DROPPED] * 3
    assert "length 3, but 2 octets follow" in events[2][1]


def test_surplus_octets_go_no_further() -> None:
    station = Station([route(FAR, LINK)])
    octets = Ams(FAR_DEVICE, CLIENT, body=b"abc").octets() + b"more"
    (forward,) = station.router.receive_packet(octets, "tcp", "1", 0)
    assert parse(*forward.packets).body == b"abc"


def test_fragments_are_put_together_and_what_is_too_long_goes_in_fragments() -> None:
    station = Station()
    narrow = Way("narrow", "1")
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
    assert "nobody waits for" in client.events()[0][1]  # it was put together: an answer


def test_fragments_are_acknowledged_to_who_wants_it() -> None:
    station = Station()
    first = parse(next(iter_fragments(Ams(DEVICE, CLIENT, body=bytes(50)).octets(), 4, 28)))
    wanting = first._replace(flags=StateFlags.ADS)
    assert station.replied(wanting, UDP) == (UDP, wanting.answer(b""))
    assert station.give(wanting, UDP, for_all=True) == []
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


def test_what_passes_is_counted() -> None:
    station = Station([route(FAR, LINK)])
    asked = Ams(FAR_DEVICE, CLIENT, body=b"12")
    onward = station.forwarded(asked, TCP)
    station.now_ns = 700
    (reply,) = station.give(onward.answer(b"1234"), LINK)
    assert isinstance(reply, Reply)
    (client,) = station.router.connections()
    hop = station.router.report(*station.table)
    assert (client.way, hop.route.hop) == (TCP, LINK)
    assert client.traffic.sources == (NetId.parse(CLIENT.partition(":")[0]),)
    for traffic in (client.traffic, hop.traffic):
        assert (traffic.requests, traffic.answers, traffic.errors) == (1, 1, 0)
        assert (traffic.octets_asked, traffic.octets_answered) == (34, 36)
        assert traffic.round_trip_ns == 700
    assert station.router.stats().counts[Outcome.ANSWERED] == 1
    assert station.router.record.latest[-1].took_ns == 700
    station.router.connection_closed(*TCP, 800)
    assert station.router.connections() == []


class Client:
    """A connection of a program; all programs have one AMS address and count from 1."""

    def __init__(self, way: Way) -> None:
        self.way = way
        self.count = 0
        self.is_open = True
        self.waiting: dict[int, tuple[Ams, int]] = {}


class RouterMachine(RuleBasedStateMachine):
    """Clients, connections and links in any order of what can happen to them.

    Every request is answered once, on the connection that it came by, with what its target said to
    it or with an error; what comes late, twice or from elsewhere reaches nobody.
    """

    LIMITS = Limits(in_flight=12, per_connection=6)
    TARGETS = (DEVICE, "5.1.1.1.2.1:1", FAR_DEVICE, "7.1.1.1.1.1:851", "9.9.9.9.9.9:1",
               "10.0.0.1.1.1:1")  # fmt: skip

    def __init__(self) -> None:
        super().__init__()
        virtual = NetId.parse("7.1.1.1.9.9")
        routes = [route(FAR, LINK), route("7.1.1.1.1.1", SECOND_LINK, timeout_ns=SECOND),
                  route("10.0.0.1.1.1", Way("narrow", "box"), real=virtual)]  # fmt: skip
        self.station = Station(routes, limits=self.LIMITS, is_probing=True)
        self.probes: list[tuple[Way, Ams]] = []
        self.clients: list[Client] = []
        self.asked: list[Deliver] = []
        self.onward: list[tuple[Forward, Ams]] = []
        self.answers: list[tuple[Way, Ams]] = []
        self.assemblers: dict[Way, Assembler] = {}
        self.opened = 0

    def client_of(self, way: Way) -> Client:
        (client,) = [each for each in self.clients if each.way == way and each.is_open]
        return client

    def act(self, actions: list[Action]) -> None:
        for action in actions:
            if isinstance(action, Deliver):
                self.asked.append(action)
            elif isinstance(action, Forward) and not action.ticket:
                self.probes.append((action.hop, parse(*action.packets)))
            elif isinstance(action, Forward):
                packet = self.whole(action.hop, action.packets)
                self.onward.append((action, packet))
            else:
                self.finish(self.client_of(action.way), parse(*action.packets))

    def whole(self, hop: Way, packets: tuple[bytes, ...]) -> Ams:
        if len(packets) == 1:
            return parse(packets[0])
        assembler = self.assemblers.setdefault(hop, Assembler())
        for each in packets:
            header, body = decode_packet(each)
            packet = assembler.receive(header, bytes(body), self.station.now_ns).packet
        assert packet is not None
        return parse(packet)

    def finish(self, client: Client, answer: Ams) -> None:
        request, _ = client.waiting.pop(answer.invoke_id)  # KeyError: answered twice, or not asked
        expected = request.answer(b"", answer.error) if answer.error else request.answer(
            b"for " + request.body
        )  # fmt: skip
        assert answer == expected
        unknown = {"9.9.9.9.9.9:1": 7, "5.1.1.1.2.1:1": 6}.get(request.target, 0)
        assert answer.error in {unknown or 0, *(() if unknown else (4, 0x1B, 0x719))}

    @rule(door=st.sampled_from(["tcp", "segment"]))
    def connect(self, door: str) -> None:
        self.opened += 1
        self.clients.append(Client(Way(door, f"10.0.0.9:{self.opened}")))

    @precondition(lambda self: self.open_clients())
    @rule(data=st.data(), whom=st.sampled_from(TARGETS), size=st.sampled_from([0, 100]))
    def ask(self, data: st.DataObject, whom: str, size: int) -> None:
        client = data.draw(st.sampled_from(self.open_clients()))
        client.count += 1
        body = f"{client.way} {client.count}".encode() + bytes(size)
        request = Ams(whom, CLIENT, invoke_id=client.count, body=body)
        client.waiting[client.count] = request, self.station.now_ns
        self.act(self.station.give(request, client.way))

    @precondition(lambda self: any(each.waiting for each in self.open_clients()))
    @rule(data=st.data())
    def ask_the_same_again_where_packets_may_be_doubled(self, data: st.DataObject) -> None:
        client = data.draw(st.sampled_from([each for each in self.open_clients() if each.waiting]))
        request, _ = data.draw(st.sampled_from(list(client.waiting.values())))
        if client.way.door == "segment":
            assert self.station.give(request, client.way) == []

    @precondition(lambda self: self.asked)
    @rule(data=st.data())
    def service_answers(self, data: st.DataObject) -> None:
        deliver = self.asked.pop(data.draw(st.integers(0, len(self.asked) - 1)))
        answer = AmsAnswer(b"for " + deliver.body)
        self.act(self.station.router.receive_answer(deliver.ticket, answer, self.station.now_ns))

    @precondition(lambda self: self.onward)
    @rule(data=st.data(), fate=st.sampled_from(["answered", "lost", "doubled", "failed"]))
    def hop_gets_a_request(self, data: st.DataObject, fate: str) -> None:
        action, packet = self.onward.pop(data.draw(st.integers(0, len(self.onward) - 1)))
        if fate == "failed":
            router, now_ns = self.station.router, self.station.now_ns
            self.act(router.send_failed(action.ticket, "no", now_ns))
        elif fate != "lost":
            answer = action.hop, packet.answer(b"for " + packet.body)
            self.answers += [answer] * (2 if fate == "doubled" else 1)

    @precondition(lambda self: self.answers)
    @rule(data=st.data(), is_lost=st.booleans())
    def answer_comes_back(self, data: st.DataObject, *, is_lost: bool) -> None:
        way, packet = self.answers.pop(data.draw(st.integers(0, len(self.answers) - 1)))
        if not is_lost:
            self.act(self.station.give(packet, way))

    @precondition(lambda self: self.answers and self.open_clients())
    @rule(data=st.data())
    def answer_comes_by_somebody_else(self, data: st.DataObject) -> None:
        _, packet = data.draw(st.sampled_from(self.answers))
        client = data.draw(st.sampled_from(self.open_clients()))
        assert self.station.give(packet, client.way) == []

    @precondition(lambda self: self.open_clients())
    @rule(data=st.data())
    def close(self, data: st.DataObject) -> None:
        client = data.draw(st.sampled_from(self.open_clients()))
        client.is_open = False
        self.act(self.station.router.connection_closed(*client.way, self.station.now_ns))

    @precondition(lambda self: self.probes)
    @rule(data=st.data())
    def probe_is_answered(self, data: st.DataObject) -> None:
        way, packet = self.probes.pop(data.draw(st.integers(0, len(self.probes) - 1)))
        assert self.station.give(packet.answer(), way) == []

    @rule(hop=st.sampled_from([LINK, SECOND_LINK, Way("link", "")]), is_up=st.booleans())
    def link_changes(self, hop: Way, *, is_up: bool) -> None:
        address = hop.connection or None
        if is_up:
            self.station.router.hop_up(hop.door, address)
        else:
            router, now_ns = self.station.router, self.station.now_ns
            self.act(router.hop_down(hop.door, address, "cut", now_ns))

    @rule(step_ns=st.sampled_from([0, SECOND // 2, SECOND, 5 * SECOND]))
    def time_passes(self, step_ns: int) -> None:
        self.station.now_ns += step_ns
        self.act(self.station.router.handle_timeout(self.station.now_ns))

    @invariant()
    def nobody_waits_longer_than_clients_do(self) -> None:
        for client in self.open_clients():
            for _, at_ns in client.waiting.values():
                assert self.station.now_ns - at_ns < 5 * SECOND

    @invariant()
    def memory_is_bounded(self) -> None:
        stats = self.station.router.stats()
        assert stats.in_flight <= self.LIMITS.in_flight
        assert sum(len(each.waiting) for each in self.open_clients()) <= stats.in_flight
        if stats.in_flight:
            assert self.station.router.next_timeout() is not None

    @invariant()
    def ids_on_the_way_differ(self) -> None:
        ids = [packet.invoke_id for _, packet in self.onward]
        assert len(set(ids)) == len(ids)

    def teardown(self) -> None:
        self.time_passes(10 * SECOND)
        assert not any(each.waiting for each in self.open_clients())
        assert self.station.router.stats().in_flight == 0
        for way, packet in self.answers:
            assert self.station.give(packet, way) == []

    def open_clients(self) -> list[Client]:
        return [each for each in self.clients if each.is_open]


TestRouterMachine = RouterMachine.TestCase


names = st.sampled_from("abcd")


@given(st.dictionaries(names, names), st.sampled_from("abcd"), st.lists(st.integers(0, 9)))
def test_stations_with_any_routes_answer_everything_and_nothing_goes_on_for_ever(
    next_of: dict[str, str], first: str, order: list[int]
) -> None:
    """Each station has one way to the target, or none; "d" is where it is."""
    stations = {}
    for number, name in enumerate("abcd"):
        stations[name] = Station(first_id=number * 7)
        if name in next_of:
            stations[name].table.add(route(FAR, Way("link", next_of[name])))
    stations["d"].router.add_device(NetId.parse(FAR), {851})
    clients = [Way("tcp", f"client {number}") for number in range(3)]
    request = Ams(FAR_DEVICE, CLIENT, body=b"x")
    moving: list[tuple[str, Way, bytes]] = [(first, each, request.octets()) for each in clients]
    answered: list[Way] = []
    steps = 0
    while moving:
        steps += 1
        here, way, packet = moving.pop((order.pop() if order else 0) % len(moving))
        router = stations[here].router
        actions = router.receive_packet(packet, *way, 0)
        for action in [*actions]:
            if isinstance(action, Deliver):
                actions += router.receive_answer(action.ticket, AmsAnswer(b"that"), 0)
        for action in actions:
            if isinstance(action, Forward):
                moving.append((action.hop.connection, Way("tcp", here), *action.packets))
            elif isinstance(action, Reply) and action.way in clients:
                answered.append(action.way)
                assert parse(*action.packets).body in {b"", b"that"}
            elif isinstance(action, Reply):
                back = Way("link", here)
                moving.append((action.way.connection, back, *action.packets))
    assert sorted(answered) == clients
    assert steps <= len(clients) * 2 * (len(stations) + 1)
