"""A router in any order of all that can happen, and any routes between several."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from eap.ams.inflight import RouterLimits
from eap.ams.reassembly import FragmentAssembler
from eap.ams.transport_table import Action, Deliver, Forward, Reply
from eap.codec.ams import AmsAnswer, decode_packet
from eap.ids import Endpoint, NetId
from tests.support.ams import Ams, parse
from tests.support.aoerouter import (
    CLIENT,
    DEVICE,
    FAR,
    FAR_DEVICE,
    LINK,
    SECOND_LINK,
    Station,
    route,
)
from tests.unit.eap.ams.test_router import SECOND


class Client:
    """A connection of a program; all programs have one AMS address and count from 1."""

    def __init__(self, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self.count = 0
        self.is_open = True
        self.waiting: dict[int, tuple[Ams, int]] = {}


class RouterMachine(RuleBasedStateMachine):
    """Clients, connections and links in any order of what can happen to them.

    Every request is answered once, on the connection that it came by, with what its target said to
    it or with an error; what comes late, twice or from elsewhere reaches nobody.
    """

    LIMITS = RouterLimits(in_flight=12, per_connection=6)
    TARGETS = (DEVICE, "5.1.1.1.2.1:1", FAR_DEVICE, "7.1.1.1.1.1:851", "9.9.9.9.9.9:1",
               "10.0.0.1.1.1:1")  # fmt: skip

    def __init__(self) -> None:
        super().__init__()
        virtual = NetId.parse("7.1.1.1.9.9")
        routes = [route(FAR, LINK), route("7.1.1.1.1.1", SECOND_LINK, timeout_ns=SECOND),
                  route("10.0.0.1.1.1", Endpoint("narrow", "box"), real=virtual)]  # fmt: skip
        self.station = Station(routes, limits=self.LIMITS, is_probing=True)
        self.probes: list[tuple[Endpoint, Ams]] = []
        self.clients: list[Client] = []
        self.asked: list[Deliver] = []
        self.onward: list[tuple[Forward, Ams]] = []
        self.answers: list[tuple[Endpoint, Ams]] = []
        self.assemblers: dict[Endpoint, FragmentAssembler] = {}
        self.opened = 0

    def client_of(self, endpoint: Endpoint) -> Client:
        (client,) = [each for each in self.clients if each.endpoint == endpoint and each.is_open]
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
                self.finish(self.client_of(action.endpoint), parse(*action.packets))

    def whole(self, hop: Endpoint, packets: tuple[bytes, ...]) -> Ams:
        if len(packets) == 1:
            return parse(packets[0])
        assembler = self.assemblers.setdefault(hop, FragmentAssembler())
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

    @rule(transport=st.sampled_from(["tcp", "segment"]))
    def connect(self, transport: str) -> None:
        self.opened += 1
        self.clients.append(Client(Endpoint(transport, f"10.0.0.9:{self.opened}")))

    @precondition(lambda self: self.open_clients())
    @rule(data=st.data(), whom=st.sampled_from(TARGETS), size=st.sampled_from([0, 100]))
    def ask(self, data: st.DataObject, whom: str, size: int) -> None:
        client = data.draw(st.sampled_from(self.open_clients()))
        client.count += 1
        body = f"{client.endpoint} {client.count}".encode() + bytes(size)
        request = Ams(whom, CLIENT, invoke_id=client.count, body=body)
        client.waiting[client.count] = request, self.station.now_ns
        self.act(self.station.give(request, client.endpoint))

    @precondition(lambda self: any(each.waiting for each in self.open_clients()))
    @rule(data=st.data())
    def ask_the_same_again_where_packets_may_be_doubled(self, data: st.DataObject) -> None:
        client = data.draw(st.sampled_from([each for each in self.open_clients() if each.waiting]))
        request, _ = data.draw(st.sampled_from(list(client.waiting.values())))
        if client.endpoint.transport == "segment":
            assert self.station.give(request, client.endpoint) == []

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
        endpoint, packet = self.answers.pop(data.draw(st.integers(0, len(self.answers) - 1)))
        if not is_lost:
            self.act(self.station.give(packet, endpoint))

    @precondition(lambda self: self.answers and self.open_clients())
    @rule(data=st.data())
    def answer_comes_by_somebody_else(self, data: st.DataObject) -> None:
        _, packet = data.draw(st.sampled_from(self.answers))
        client = data.draw(st.sampled_from(self.open_clients()))
        assert self.station.give(packet, client.endpoint) == []

    @precondition(lambda self: self.open_clients())
    @rule(data=st.data())
    def close(self, data: st.DataObject) -> None:
        client = data.draw(st.sampled_from(self.open_clients()))
        client.is_open = False
        self.act(self.station.router.connection_closed(*client.endpoint, self.station.now_ns))

    @precondition(lambda self: self.probes)
    @rule(data=st.data())
    def probe_is_answered(self, data: st.DataObject) -> None:
        endpoint, packet = self.probes.pop(data.draw(st.integers(0, len(self.probes) - 1)))
        assert self.station.give(packet.answer(), endpoint) == []

    @rule(hop=st.sampled_from([LINK, SECOND_LINK, Endpoint("link", "")]), is_up=st.booleans())
    def link_changes(self, hop: Endpoint, *, is_up: bool) -> None:
        address = hop.connection or None
        if is_up:
            self.station.router.hop_up(hop.transport, address)
        else:
            router, now_ns = self.station.router, self.station.now_ns
            self.act(router.hop_down(hop.transport, address, "cut", now_ns))

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
        for endpoint, packet in self.answers:
            assert self.station.give(packet, endpoint) == []

    def open_clients(self) -> list[Client]:
        return [each for each in self.clients if each.is_open]


TestRouterMachine = RouterMachine.TestCase

names = st.sampled_from("abcd")


@given(st.dictionaries(names, names), st.sampled_from("abcd"), st.lists(st.integers(0, 9)))
def test_stations_with_any_routes_answer_all_requests_in_time(
    next_of: dict[str, str], first: str, order: list[int]
) -> None:
    """Each station has one way to the target, or none; "d" is where it is."""
    stations = {}
    for number, name in enumerate("abcd"):
        stations[name] = Station(first_id=number * 7)
        if name in next_of:
            stations[name].table.add(route(FAR, Endpoint("link", next_of[name])))
    stations["d"].router.add_device(NetId.parse(FAR), {851})
    clients = [Endpoint("tcp", f"client {number}") for number in range(3)]
    request = Ams(FAR_DEVICE, CLIENT, body=b"x")
    moving: list[tuple[str, Endpoint, bytes]] = [
        (first, each, request.octets()) for each in clients
    ]
    answered: list[Endpoint] = []
    steps = 0
    while moving:
        steps += 1
        here, endpoint, packet = moving.pop((order.pop() if order else 0) % len(moving))
        router = stations[here].router
        actions = router.receive_packet(packet, *endpoint, 0)
        for action in [*actions]:
            if isinstance(action, Deliver):
                actions += router.receive_answer(action.ticket, AmsAnswer(b"that"), 0)
        for action in actions:
            if isinstance(action, Forward):
                moving.append((action.hop.connection, Endpoint("tcp", here), *action.packets))
            elif isinstance(action, Reply) and action.endpoint in clients:
                answered.append(action.endpoint)
                assert parse(*action.packets).body in {b"", b"that"}
            elif isinstance(action, Reply):
                back = Endpoint("link", here)
                moving.append((action.endpoint.connection, back, *action.packets))
    assert sorted(answered) == clients
    assert steps <= len(clients) * 2 * (len(stations) + 1)
