"""A station's router in its loop: transports, services, time-outs, timer, local clients."""

from __future__ import annotations

import asyncio
from time import monotonic_ns

import pytest

from eap.ams.access import AccessList
from eap.ams.inflight import RouterLimits
from eap.ams.routes import Route
from eap.ams.spec import AccessRule
from eap.ams.transport_table import Transport
from eap.codec.ams import AmsAnswer, AmsHeader
from eap.ids import Endpoint, NetId
from eap.services.routing import station_router
from eap.services.routing.station_router import RouterTimer, StationRouter
from tests.support import aoe
from tests.support.ams import ADD_NOTIFICATION, NOTIFICATION, Ams
from tests.support.eventually import elapse, eventually, settle
from tests.support.routing import RecordingSender, StubService, while_serving
from tests.support.virtualtime import run_virtual

ROUTER, DEVICE = NetId.parse("1.1.1.1.1.1"), NetId.parse("1.1.1.1.2.1")
CLIENT = "192.168.9.9.1.1:33000"
FAR = "7.7.7.7.1.1:851"
HOP = Endpoint("out", "hop")
PEER = Endpoint("in", "peer")
TRANSPORTS = (
    Transport("in", is_stream=True, is_hub=True),
    Transport("out"),
    Transport("narrow", max_size=60),
    Transport("ams-tcp", is_stream=True),
)


class Scene:
    """A station with transports whose packets are kept."""

    def __init__(self, **more: object) -> None:
        self.sender = RecordingSender()
        self.service = StubService()
        self.station = StationRouter("island", ROUTER, [DEVICE], **more)
        self.station.add_service(DEVICE, self.service)
        for transport in TRANSPORTS:
            self.station.add_transport(transport, self.sender)

    def add_route(self, **more: object) -> None:
        net_id = NetId.parse(FAR.partition(":")[0])
        self.station.add_route(Route(net_id, "far", HOP, is_probed=False, **more))

    def ask(self, target: str = f"{DEVICE}:65535", endpoint: Endpoint = PEER, **more) -> None:
        self.station.receive(Ams(target, CLIENT, **more).octets(), *endpoint)

    @property
    def sent(self) -> list[Ams]:
        return [packet for _, packet in self.sender.sent]


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_service_answers_where_the_request_came_from(scene):
    scene.ask(body=b"abc", invoke_id=5)
    ((connection, answer),) = scene.sender.sent
    assert connection == "peer"
    assert (answer.target, answer.source) == (CLIENT, f"{DEVICE}:65535")
    assert (answer.flags, answer.invoke_id, answer.body) == (5, 5, b"\0\0\0\0\2cba")


def test_first_service_that_has_the_port_answers(scene):
    scene.station.add_service(DEVICE, slave := StubService(lambda _: AmsAnswer(b"1001"), 1001))
    scene.ask(f"{DEVICE}:1001")
    scene.ask(f"{DEVICE}:1002")
    slave.ports.add(1002)
    scene.ask(f"{DEVICE}:1002")
    slave.ports.remove(1001)
    scene.ask(f"{DEVICE}:1001")
    assert [(each.error, each.body) for each in scene.sent] == [
        (0, b"1001"),
        (6, b""),
        (0, b"1001"),
        (6, b""),
    ]


class PromptService(StubService):
    """Has some answers at hand, and fails at a body that says so."""

    def answer_now(self, header: AmsHeader, body: bytes) -> AmsAnswer | None:
        if body == b"fail":
            raise RuntimeError("a fault")
        return AmsAnswer(b"now " + body) if body[:4] == b"fast" else None


def test_immediate_answer_bypasses_the_queue(scene):
    scene.service.ports.clear()
    scene.station.add_service(DEVICE, PromptService())
    for number, body in enumerate((b"fast", b"slow", b"fail")):
        scene.ask(body=body, invoke_id=number)
    found = [(each.invoke_id, each.body) for each in scene.sent]
    assert found == [(0, b"now fast"), (1, bytes(4) + b"\2wols"), (2, bytes(4) + b"\2liaf")]
    assert scene.station.stats().in_flight == 0
    traffic = scene.station.record.connections.snapshot()[PEER]
    assert (traffic.requests, traffic.answers) == (3, 3)


def test_immediate_answer_does_not_overtake_earlier_requests_of_its_client(scene):
    access_filter = asyncio.Event()

    async def wait(request):
        await access_filter.wait()
        return AmsAnswer(request.body)

    async def script():
        scene.station.add_service(DEVICE, PromptService(wait, 1001))
        other = Endpoint("in", "other")
        scene.ask(f"{DEVICE}:1001", body=b"slow")
        scene.ask(f"{DEVICE}:1001", body=b"fast")
        scene.ask(f"{DEVICE}:1001", other, body=b"fast of another")
        access_filter.set()
        await settle()

    run_virtual(while_serving(script(), scene.station))
    assert [each.body for each in scene.sent] == [b"now fast of another", b"slow", b"fast"]


def test_long_answer_is_fragmented_by_a_transport_with_small_packets(scene):
    scene.ask(endpoint=Endpoint("narrow", "peer"), body=b"x" * 100)
    assert [each.command for each in scene.sent] == [0x0902] * 5


def test_access_rules_come_before_services():
    scene = Scene(access=AccessList([AccessRule("nobody", allow=False)]))
    entries = []
    scene.station.on_audit.append(entries.append)
    scene.ask(body=aoe.read_body(0))
    (answer,) = scene.sent
    assert (answer.error, answer.body[:4]) == (0x723, b"")
    assert [each.header.target for each in entries] == [DEVICE]


def test_audit_is_kept_before_the_answer_leaves():
    scene = Scene(access=AccessList([AccessRule("nobody", allow=False)]))
    sent = []
    scene.station.on_audit.append(lambda _: sent.append(len(scene.sent)))
    scene.ask(body=aoe.read_body(0))
    assert (sent, len(scene.sent)) == ([0], 1)


def test_own_source_net_id_is_accepted_from_this_host_only(scene):
    packet = Ams(f"{DEVICE}:65535", f"{ROUTER}:300", command=aoe.READ_STATE).octets()
    scene.station.receive(packet, "ams-tcp", "10.0.0.9:4711#1")
    scene.station.receive(packet, "ams-tcp", "127.0.0.1:4711#2")
    assert [each.error for each in scene.sent] == [7, 0]


def test_request_goes_on_and_its_answer_comes_back(scene):
    scene.add_route()
    scene.ask(FAR, invoke_id=5)
    assert scene.sender.sent[0][0] == "hop"
    scene.station.receive(scene.sent[0].answer(b"far").octets(), *HOP)
    connection, answer = scene.sender.sent[1]
    assert (connection, answer.invoke_id, answer.body) == ("peer", 5, b"far")


def test_send_failure_of_a_transport_is_answered_and_logged(scene, caplog):
    scene.add_route()
    scene.station.add_transport(Transport("dead"), sender := RecordingSender())
    sender.error = "no cable"
    net_id = NetId.parse("8.8.8.8.1.1")
    scene.station.add_route(Route(net_id, "dead end", Endpoint("dead", "hop"), is_probed=False))
    scene.ask("8.8.8.8.1.1:1")
    assert [each.error for each in scene.sent] == [0x1B]
    assert "island: READ of 8.8.8.8.1.1:1" in caplog.text
    assert "dead end (hop by dead): no cable (0x1b)" in caplog.text


def test_requests_to_a_hop_that_is_down_fail_at_once_until_it_is_up(scene):
    scene.add_route()
    scene.ask(FAR)
    scene.station.hop_down("out", None, "no link")
    assert scene.station.is_down(HOP)
    scene.ask(FAR, invoke_id=2)
    scene.station.hop_up("out", None)
    scene.ask(FAR, invoke_id=3)
    assert [(each.error, each.target) for each in scene.sent] == [
        (0, FAR),
        (0x1B, CLIENT),
        (0x1B, CLIENT),
        (0, FAR),
    ]


def test_time_is_up_at_a_hop_and_at_a_service():
    scene = Scene(limits=RouterLimits(timeout_ns=20_000_000))
    scene.add_route(timeout_ns=10_000_000)

    async def never(request):
        await asyncio.Event().wait()

    scene.station.add_service(ROUTER, StubService(never, 1))

    async def script():
        scene.ask(FAR)
        scene.ask(f"{ROUTER}:1", invoke_id=2)
        await eventually(lambda: len(scene.sent) >= 3)

    run_virtual(while_serving(script(), scene.station))
    assert [(each.error, each.invoke_id) for each in scene.sent[1:]] == [(0x719, 1), (0x719, 2)]


def test_hops_are_probed_as_soon_as_there_is_a_route(scene):
    async def script():
        await asyncio.sleep(0)
        scene.station.add_route(Route(NetId.parse("7.7.7.7.1.1"), "far", HOP))
        await eventually(lambda: scene.sent)
        assert scene.station.remove_route(NetId.parse("7.7.7.7.1.1"), HOP)

    run_virtual(while_serving(script(), scene.station))
    (probe,) = scene.sent
    assert (probe.target, probe.command) == ("7.7.7.7.1.1:10000", 4)


def test_services_are_notified_of_a_closed_connection(scene):
    scene.station.connection_closed("in", "peer")
    assert scene.service.gone == [Endpoint("in", "peer")]


def test_services_are_notified_of_a_hop_dead_for_long(scene, monkeypatch):
    now_ns = 0
    monkeypatch.setattr(station_router, "monotonic_ns", lambda: now_ns)
    scene.station.add_route(Route(NetId.parse("7.7.7.7.1.1"), "far", HOP))
    for second in range(70):
        assert scene.service.gone == ([HOP] if second > 62 else [])
        now_ns = second * 1_000_000_000
        scene.station._handle_timeout()


def test_notifications_go_to_their_clients_and_pass(scene):
    notice = Ams(CLIENT, f"{DEVICE}:65535", NOTIFICATION).octets()
    scene.station.send_notification(Endpoint("in", "peer"), notice)
    scene.station.send_notification(Endpoint("gone", "peer"), notice)
    assert [name for name, _ in scene.sender.sent] == ["peer"]
    scene.add_route()
    scene.ask(FAR, command=ADD_NOTIFICATION, body=bytes(40))
    scene.station.receive(scene.sent[1].answer(bytes(4) + b"\7\0\0\0").octets(), *HOP)
    sample = bytes.fromhex("15000000 01000000 0000000000000000 01000000 07000000 01000000 55")
    scene.station.receive(Ams(CLIENT, FAR, NOTIFICATION, body=sample).octets(), *HOP)
    connection, loop_detector = scene.sender.sent[3]
    assert (connection, loop_detector.command, loop_detector.body) == ("peer", NOTIFICATION, sample)
    scene.station.connection_closed("in", "peer")
    assert (scene.sent[4].target, scene.sent[4].command) == (FAR, 7)


def test_removed_transport_answers_its_pending_requests(scene):
    scene.add_route()
    scene.ask(FAR)
    scene.station.remove_transport("out")
    scene.ask(FAR, invoke_id=2)
    assert [each.error for each in scene.sent[1:]] == [0x1B, 0x1B]
    scene.add_route()
    scene.station.add_transport(Transport("out"), scene.sender)
    scene.ask(FAR, invoke_id=3)
    scene.station.remove_transport("in")
    scene.station.receive(scene.sent[3].answer().octets(), *HOP)
    assert len(scene.sent) == 4


def test_reader_waits_while_too_many_of_its_requests_do(scene):
    access_filter = asyncio.Event()

    async def slow(request):
        await access_filter.wait()
        return AmsAnswer()

    scene.station.add_service(ROUTER, StubService(slow, 1))

    async def script():
        scene.ask(f"{ROUTER}:1")
        scene.ask(f"{ROUTER}:1", invoke_id=2)
        await scene.station.wait_below("in", "peer", 3)
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(scene.station.wait_below("in", "peer", 2), 0.01)
        access_filter.set()
        await scene.station.wait_below("in", "peer", 1)

    run_virtual(while_serving(script(), scene.station))
    assert len(scene.sent) == 2


def test_traces_reach_all_observers(scene):
    traces = []
    scene.station.on_trace.append(traces.append)
    scene.ask("9.9.9.9.1.1:1")
    assert [each.error_code for each in traces] == [7]
    assert scene.station.stats().counts["failed"] == 1


def test_station_knows_its_net_ids(scene):
    assert set(scene.station.net_ids) == {ROUTER, DEVICE}
    with pytest.raises(KeyError):
        scene.station.add_service(NetId.parse("2.2.2.2.2.2"), scene.service)


def test_route_observers_are_notified_of_each_change() -> None:
    scene = Scene()
    told: list[Endpoint] = []
    scene.station.on_routes.append(told.append)
    scene.add_route()
    scene.station.remove_route(NetId.parse("7.7.7.7.1.1"), HOP)
    assert told == [HOP, HOP]


MS = 1_000_000


class Clock:
    """Something with a next time-out; it notes when it was called."""

    def __init__(self) -> None:
        self.due_ns: int | None = None
        self.rang_ns: list[int] = []
        self.rang = asyncio.Event()
        self.timer = RouterTimer(lambda: self.due_ns, self._handle)

    def set(self, in_ms: int) -> int:
        self.due_ns = monotonic_ns() + in_ms * MS
        self.timer.set()
        return self.due_ns

    def _handle(self) -> None:
        self.rang_ns.append(monotonic_ns())
        self.due_ns = None
        self.rang.set()


def play(script):
    async def run():
        clock = Clock()
        async with asyncio.timeout(10):
            await script(clock)
        clock.timer.stop()

    run_virtual(run())


def test_timer_fires_at_the_due_time():
    async def script(clock):
        clock.timer.start()
        clock.set(10_000)
        due_ns = clock.set(30)  # the earlier one counts
        clock.set(10_000)
        await clock.rang.wait()
        assert clock.rang_ns[0] >= due_ns - MS

    play(script)


def test_timer_overdue_does_not_keep_the_loop_busy():
    async def script(clock):
        clock.timer.start()
        clock.set(-1000)
        await asyncio.sleep(0)
        assert not clock.rang_ns
        await clock.rang.wait()

    play(script)


def test_timer_set_soon_is_shared():
    async def script(clock):
        clock.timer.start()
        clock.set(10_000)
        for _ in range(1000):
            clock.timer.set_soon()
            clock.set(1)  # it is looked up after the moment
        await clock.rang.wait()
        await elapse(0.05)
        assert len(clock.rang_ns) == 1

    play(script)


def test_timer_does_not_fire_before_start_and_after_stop():
    async def script(clock):
        clock.set(1)
        clock.timer.set_soon()
        await elapse(0.05)
        assert not clock.rang_ns
        clock.timer.start()
        clock.timer.stop()
        clock.set(1)
        await elapse(0.05)
        assert not clock.rang_ns

    play(script)


def test_timer_start_handles_what_was_due_before():
    async def script(clock):
        clock.set(1)
        clock.timer.start()
        await clock.rang.wait()

    play(script)
