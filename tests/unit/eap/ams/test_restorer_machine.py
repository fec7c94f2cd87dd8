"""Subscriptions through a router in any order of what can happen to their way and their server."""

from __future__ import annotations

from collections import deque

from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from eap.ams.transport_table import Action, Forward, Reply
from eap.codec.adsnotification import (
    AddNotification,
    NotificationSample,
    Stamp,
    TransMode,
    decode_notification,
    encode_notification,
)
from eap.ids import Endpoint
from tests.support.ams import ADD_NOTIFICATION, DELETE_NOTIFICATION, NOTIFICATION, Ams, parse
from tests.support.aoerouter import CLIENT, FAR, FAR_DEVICE, LINK, Station, route

SECOND = 1_000_000_000
STEP_NS = SECOND // 2


class Server:
    """Grants notifications; its handles may begin with 1 again at each start."""

    def __init__(self) -> None:
        self.watched: dict[int, int] = {}
        self.has_object = True
        self.last = 0

    def answer(self, packet: Ams) -> Ams | None:
        handle = int.from_bytes(packet.body[:4], "little")
        if packet.command == ADD_NOTIFICATION:
            if not self.has_object:
                return packet.answer((0x70C).to_bytes(4, "little") + bytes(4))
            self.last = handle = self.last + 1
            self.watched[handle] = AddNotification.decode(packet.body).offset
            return packet.answer(bytes(4) + handle.to_bytes(4, "little"))
        assert packet.command == DELETE_NOTIFICATION
        is_known = self.watched.pop(handle, None) is not None
        if packet.flags & 2:
            return None
        return packet.answer((0 if is_known else 0x714).to_bytes(4, "little"))

    def sample(self, handles: list[int], *, is_end: bool = False) -> Ams:
        samples = [
            NotificationSample(each, b"" if is_end else self.watched[each].to_bytes(4, "little"))
            for each in handles
        ]
        packets = [Stamp(1, (each,)) for each in samples]
        return Ams(CLIENT, FAR_DEVICE, NOTIFICATION, body=encode_notification(packets))


class RestorerMachine(RuleBasedStateMachine):
    """Clients never get what they did not subscribe to, and in the end all that they did.

    A subscription delivers again when its way and its server are good again, or its client got the
    sample that ends it; the server has no notification that no client wants.
    """

    def __init__(self) -> None:
        super().__init__()
        self.station = Station([route(FAR, LINK)], is_probing=False)
        self.server = Server()
        self.to_server: deque[Ams] = deque()
        self.to_router: deque[Ams] = deque()
        self.is_up = True
        self.loses = False
        self.number = 0
        self.clients: set[Endpoint] = set()
        self.asked: dict[tuple[Endpoint, int], Ams] = {}
        self.subscribed: dict[tuple[Endpoint, int], int] = {}
        self.came: dict[tuple[Endpoint, int], int] = {}

    def act(self, actions: list[Action]) -> None:
        for action in actions:
            if isinstance(action, Forward) or action.endpoint == LINK:
                if self.is_up:
                    self.to_server.append(parse(*action.packets))
            else:
                assert isinstance(action, Reply)
                self.finish(action.endpoint, parse(*action.packets))

    def finish(self, endpoint: Endpoint, packet: Ams) -> None:
        if endpoint not in self.clients:
            return
        if packet.command == NOTIFICATION:
            for stamp in decode_notification(packet.body):
                for sample in stamp.samples:
                    self.take_sample(endpoint, *sample)
            return
        request = self.asked.pop((endpoint, packet.invoke_id))
        if request.command == ADD_NOTIFICATION and not packet.error and not any(packet.body[:4]):
            key = endpoint, int.from_bytes(packet.body[4:], "little")
            assert key not in self.subscribed
            self.subscribed[key] = AddNotification.decode(request.body).offset
            self.came[key] = self.station.now_ns

    def take_sample(self, endpoint: Endpoint, handle: int, data: bytes) -> None:
        if not data:
            del self.subscribed[endpoint, handle]
        else:
            assert int.from_bytes(data, "little") == self.subscribed[endpoint, handle]
            self.came[endpoint, handle] = self.station.now_ns

    def ask(self, endpoint: Endpoint, command: int, body: bytes) -> None:
        self.number += 1
        packet = Ams(FAR_DEVICE, CLIENT, command, invoke_id=self.number, body=body)
        self.asked[endpoint, self.number] = packet
        self.act(self.station.give(packet, endpoint))

    @initialize(
        loses=st.booleans(), modes=st.lists(st.sampled_from([3, 4]), min_size=1, max_size=4)
    )
    def begin(self, modes: list[int], *, loses: bool) -> None:
        """Let packets be lost, or the server give the same handles again, but not both.

        With both it cannot be known whose a sample is.
        """
        self.loses = loses
        for mode in modes:
            self.open_and_subscribe(mode)
        self.settle()

    def open_and_subscribe(self, mode: int) -> None:
        endpoint = Endpoint("tcp", f"10.0.0.9:{self.number}")
        self.clients.add(endpoint)
        self.ask_for(endpoint, mode)

    def ask_for(self, endpoint: Endpoint, mode: int) -> None:
        request = AddNotification(0x4040, self.number + 1, 4, TransMode(mode), 0, 500_000)
        self.ask(endpoint, ADD_NOTIFICATION, request.encode())

    @rule()
    def settle(self) -> None:
        """Let all packets arrive."""
        while self.to_server or self.to_router:
            if self.to_server:
                self.server_takes(is_lost=False)
            if self.to_router:
                self.router_takes(is_lost=False)

    @rule(
        is_new=st.booleans(), is_settled=st.booleans(), mode=st.sampled_from([3, 4]), data=st.data()
    )
    def subscribe(self, *, is_new: bool, is_settled: bool, mode: int, data: st.DataObject) -> None:
        if is_new or not self.clients:
            self.open_and_subscribe(mode)
        else:
            self.ask_for(data.draw(st.sampled_from(sorted(self.clients))), mode)
        if is_settled:
            self.settle()

    @precondition(lambda self: self.subscribed)
    @rule(data=st.data())
    def delete(self, data: st.DataObject) -> None:
        endpoint, handle = data.draw(st.sampled_from(sorted(self.subscribed)))
        del self.subscribed[endpoint, handle]
        self.ask(endpoint, DELETE_NOTIFICATION, handle.to_bytes(4, "little"))

    @precondition(lambda self: self.clients)
    @rule(data=st.data())
    def close(self, data: st.DataObject) -> None:
        endpoint = data.draw(st.sampled_from(sorted(self.clients)))
        self.clients.remove(endpoint)
        for known in (self.subscribed, self.asked):
            for key in [key for key in known if key[0] == endpoint]:
                del known[key]
        self.act(self.station.router.connection_closed(*endpoint, self.station.now_ns))

    @precondition(lambda self: self.to_server)
    @rule(is_lost=st.booleans())
    def server_takes(self, *, is_lost: bool) -> None:
        packet = self.to_server.popleft()
        answer = None if is_lost and self.loses else self.server.answer(packet)
        if answer is not None and self.is_up:
            self.to_router.append(answer)

    @precondition(lambda self: self.to_router)
    @rule(is_lost=st.booleans())
    def router_takes(self, *, is_lost: bool) -> None:
        packet = self.to_router.popleft()
        if not is_lost or not self.loses:
            self.act(self.station.give(packet, LINK))

    @precondition(lambda self: self.server.watched)
    @rule(is_end=st.sampled_from([False, False, True]))
    def server_samples(self, *, is_end: bool) -> None:
        handles = sorted(self.server.watched)
        if self.is_up:
            self.to_router.append(self.server.sample(handles, is_end=is_end))
        if is_end:
            self.server.watched.clear()

    @rule(has_object=st.sampled_from([True, True, False]))
    def server_starts_again(self, *, has_object: bool) -> None:
        self.server.watched.clear()
        self.server.has_object = has_object
        if not self.loses:
            self.server.last = 0
        self.to_server.clear()

    @rule()
    def hop_goes_and_comes(self) -> None:
        self.is_up = not self.is_up
        router, now_ns = self.station.router, self.station.now_ns
        if self.is_up:
            router.hop_up(*LINK)
        else:
            self.to_server.clear()
            self.to_router.clear()
            self.act(router.hop_down(*LINK, "no link", now_ns))

    @rule(steps=st.integers(1, 20))
    def time_passes(self, steps: int) -> None:
        for _ in range(steps):
            self.station.now_ns += STEP_NS
            self.act(self.station.router.handle_timeout(self.station.now_ns))

    def teardown(self) -> None:
        if not self.is_up:
            self.hop_goes_and_comes()
        self.server.has_object = True
        for _ in range(300):
            self.time_passes(1)
            self.settle()
            if self.server.watched:
                self.server_samples(is_end=False)
        assert not self.asked
        now_ns, router = self.station.now_ns, self.station.router
        assert all(now_ns - self.came[key] <= SECOND for key in self.subscribed)
        assert sorted(self.server.watched.values()) == sorted(self.subscribed.values())
        assert router.stats().in_flight == 0
        assert router.stats().subscriptions == len(self.subscribed)
        assert router.interruptions() == []


TestRestorer = RestorerMachine.TestCase
