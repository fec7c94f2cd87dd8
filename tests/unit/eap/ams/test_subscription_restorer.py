"""Interrupted subscriptions, step by step."""

from __future__ import annotations

import gc
import struct

import msgspec
import pytest

from eap.ams.inflight import InvokeIds, RouterLimits
from eap.ams.record import Outcome
from eap.ams.subscription_restorer import (
    GROUP,
    MAX_ENDS,
    MAX_REQUESTS,
    RETRY_NS,
    STARTUP_TIMEOUT_NS,
    TIMEOUT_NS,
)
from eap.ams.subscriptions import Subscription
from eap.ams.transport_table import Action, Forward
from eap.codec.adsnotification import AddNotification, TransMode
from eap.codec.ams import SYSTEM_PORT, AmsCommand, AmsHeader, decode_packet
from tests.support.ams import ADD_NOTIFICATION, DELETE_NOTIFICATION, READ_WRITE, Ams, parse
from tests.support.aoerouter import FAR, LINK, Station, only_reply, route
from tests.unit.eap.ams.test_notification_forwarder import ADD, NOTICE, ONE, granted
from tests.unit.eap.ams.test_subscriptions import stream

SECOND = 1_000_000_000
END = stream((0, {1: b""}))
CYCLIC = AddNotification(0x4040, 8, 4, TransMode.SERVER_CYCLE, 0, 500_000)
ON_CHANGE = AddNotification(0x4040, 8, 4, TransMode.SERVER_ON_CHANGE, 0, 500_000)


class Scene:
    """A client with subscriptions through a router; handles at the server count from 1."""

    def __init__(self, *requests: AddNotification, **more: bool) -> None:
        self.station = Station([route(FAR, LINK, "far")], **more)
        self.asked: list[Ams] = []
        for handle, request in enumerate(requests, 1):
            packet = ADD._replace(invoke_id=handle, body=request.encode())
            onward = self.station.forwarded(packet, ONE)
            self.station.replied(onward.answer(granted(handle)), LINK)

    def take(self, actions: list[Action]) -> list[Ams]:
        """Return what the client gets; remember what the server is asked."""
        replies = []
        for action in actions:
            packet = parse(*action.packets)
            if isinstance(action, Forward):
                self.asked.append(packet)
            else:
                replies.append(packet)
        return replies

    def answer(self, packet: Ams, body: bytes, error: int = 0) -> list[Ams]:
        return self.take(self.station.give(packet.answer(body, error), LINK))

    def passes(self, ns: int) -> list[Ams]:
        self.station.now_ns += ns
        self.asked.clear()
        return self.take(self.station.router.handle_timeout(self.station.now_ns))

    def lose_hop(self) -> list[Ams]:
        found = self.take(self.station.router.hop_down(*LINK, "no link", self.station.now_ns))
        self.station.router.hop_up(*LINK)
        return found

    def sample(self, handle: int, data: bytes = b"data") -> list[Ams]:
        notice = NOTICE._replace(body=stream((5, {handle: data})))
        return self.take(self.station.give(notice, LINK))


def test_subscription_is_restored_with_its_handle_and_the_one_before_is_deleted() -> None:
    scene = Scene(CYCLIC)
    assert scene.lose_hop() == []
    (missing,) = scene.station.router.interruptions()
    assert (missing.endpoint, missing.number, missing.since_ns, missing.why) == (
        ONE,
        1,
        0,
        "no link",
    )
    assert scene.passes(0) == []
    (add,) = scene.asked
    assert (add.command, add.body) == (ADD_NOTIFICATION, CYCLIC.encode())
    assert scene.answer(add, granted(7)) == []
    *_, delete = scene.asked
    assert (delete.command, delete.body) == (DELETE_NOTIFICATION, b"\1\0\0\0")
    scene.answer(delete, bytes(4))
    (sample,) = scene.sample(7)
    assert sample.body == stream((5, {1: b"data"}))
    assert scene.station.router.interruptions() == []
    assert [outcome for outcome, _ in scene.station.events()] == [
        Outcome.INTERRUPTED,
        Outcome.RESTORED,
    ]
    assert scene.station.router.stats().in_flight == 0


@pytest.mark.parametrize("error", [0x702, 0x704, 0x70C, 0x710, 0x723])
def test_restorer_ends_subscription_refused_for_good(error: int) -> None:
    scene = Scene(CYCLIC)
    scene.lose_hop()
    scene.passes(0)
    (end,) = scene.answer(scene.asked[0], granted(0, error))
    assert end == NOTICE._replace(body=END, invoke_id=0)
    assert scene.station.router.stats().subscriptions == 0
    assert "cannot be restored" in scene.station.events()[-1][1]


def test_restorer_retries_at_starting_server_for_some_time() -> None:
    scene = Scene(CYCLIC)
    scene.lose_hop()
    scene.passes(0)
    for _ in range(STARTUP_TIMEOUT_NS // RETRY_NS):
        assert scene.answer(scene.asked[0], b"", 6) == []
        scene.passes(RETRY_NS)
        assert len(scene.asked) == 1
    (end,) = scene.answer(scene.asked[0], b"", 6)
    assert end.body == END


@pytest.mark.parametrize("error", [0x7, 0x1B, 0x719, 0x708])
def test_restorer_retries_while_the_path_is_down(error: int) -> None:
    scene = Scene(CYCLIC)
    scene.lose_hop()
    scene.passes(0)
    for _ in range(100):
        assert scene.answer(scene.asked[0], b"", error) == []
        assert scene.passes(RETRY_NS) == []
    assert scene.station.router.interruptions()[0].since_ns == 0
    scene.answer(scene.asked[0], granted(7))
    assert scene.sample(7)


def test_restorer_tries_one_subscription_then_groups() -> None:
    scene = Scene(*[CYCLIC] * (GROUP + 5))
    scene.lose_hop()
    scene.passes(0)
    assert len(scene.asked) == 1
    scene.answer(scene.asked[0], granted(100))
    scene.answer(scene.asked[-1], bytes(4))
    scene.passes(RETRY_NS)
    assert len(scene.asked) == GROUP
    for number, add in enumerate(scene.asked[:]):
        scene.answer(add, granted(200 + number))
    assert [each.command for each in scene.asked[GROUP:]] == [DELETE_NOTIFICATION] * GROUP


def test_restorer_tries_many_clients_soon_after_hop_is_up() -> None:
    scene = Scene()
    for number in range(1, 201):
        client = f"192.168.0.9.1.1:{30000 + number}"
        packet = ADD._replace(source=client, invoke_id=number, body=CYCLIC.encode())
        onward = scene.station.forwarded(packet, ONE)
        scene.station.replied(onward.answer(granted(number)), LINK)
    scene.take(scene.station.router.hop_down(*LINK, "no link", scene.station.now_ns))
    scene.passes(0)
    scene.station.router.hop_up(*LINK)
    scene.passes(RETRY_NS)
    assert len(scene.asked) == MAX_REQUESTS


def test_client_deletes_an_interrupted_subscription() -> None:
    scene = Scene(CYCLIC)
    scene.lose_hop()
    scene.passes(0)
    (add,) = scene.asked
    delete = ADD._replace(command=DELETE_NOTIFICATION, invoke_id=9, body=b"\1\0\0\0")
    (answer,) = scene.take(scene.station.give(delete, ONE))
    assert answer == delete.answer(bytes(4))
    assert scene.answer(add, granted(7)) == []
    ended = [each.body[0] for each in scene.asked if each.command == DELETE_NOTIFICATION]
    assert ended == [1, 7]
    assert scene.station.router.interruptions() == []


def lose_symbol() -> tuple[Scene, Ams]:
    """Return the scene behind the loss of a subscription by symbol handle, and its lookup."""
    scene = Scene()
    name = b"MAIN.level\0"
    look_up = ADD._replace(
        command=READ_WRITE, body=struct.pack("<IIII", 0xF003, 0, 4, len(name)) + name
    )
    found = struct.pack("<III", 0, 4, 55)
    scene.station.replied(scene.station.forwarded(look_up, ONE).answer(found), LINK)
    request = AddNotification(0xF005, 55, 4, TransMode.SERVER_CYCLE, 0, 500_000)
    add = ADD._replace(invoke_id=2, body=request.encode())
    scene.station.replied(scene.station.forwarded(add, ONE).answer(granted(1)), LINK)
    scene.lose_hop()
    scene.passes(0)
    return scene, look_up


def test_symbol_is_looked_up_again_by_its_name() -> None:
    scene, look_up = lose_symbol()
    assert (scene.asked[0].command, scene.asked[0].body) == (READ_WRITE, look_up.body)
    scene.answer(scene.asked[0], struct.pack("<III", 0, 4, 66))
    assert AddNotification.decode(scene.asked[1].body).offset == 66
    scene.answer(scene.asked[1], granted(7))
    scene.answer(scene.asked[2], bytes(4))
    assert scene.sample(7)
    ended = [parse(*each.packets) for each in scene.station.router.connection_closed(*ONE, 1)]
    assert [each.command for each in ended] == [DELETE_NOTIFICATION, AmsCommand.WRITE]
    assert ended[1].body == struct.pack("<IIII", 0xF006, 0, 4, 66)


@pytest.mark.parametrize(("group", "head"), [(0xF007, 8), (0xF009, 12)])
def test_restorer_looks_up_symbol_location_again(group: int, head: int) -> None:
    scene = Scene()
    name = b"MAIN.level\0"
    look_up = ADD._replace(
        command=READ_WRITE, body=struct.pack("<IIII", group, 0, 64, len(name)) + name
    )

    def entry(offset: int) -> bytes:
        return bytes(head) + struct.pack("<III", 0x4040, offset, 4)

    scene.station.replied(scene.station.forwarded(look_up, ONE).answer(entry(8)), LINK)
    add = ADD._replace(invoke_id=2, body=CYCLIC.encode())
    scene.station.replied(scene.station.forwarded(add, ONE).answer(granted(1)), LINK)
    scene.lose_hop()
    scene.passes(0)
    assert scene.asked[0].body == look_up.body
    scene.answer(scene.asked[0], entry(16))
    assert scene.asked[1].body == msgspec.structs.replace(CYCLIC, offset=16).encode()
    scene.answer(scene.asked[1], granted(7))
    assert scene.sample(7)


def test_symbol_handle_of_unknown_name_is_not_trusted() -> None:
    scene = Scene(AddNotification(0xF005, 55, 4, TransMode.SERVER_CYCLE, 0, 500_000))
    scene.lose_hop()
    (end,) = scene.passes(0)
    assert end.body == END


def test_restorer_retries_ended_subscription_a_few_times() -> None:
    scene = Scene(CYCLIC)
    for handle in range(1, MAX_ENDS):
        assert scene.sample(handle, b"") == []
        scene.passes(RETRY_NS)
        scene.answer(scene.asked[0], granted(handle + 1))
    (end,) = scene.sample(MAX_ENDS, b"")
    assert end.body == END


def test_restorer_checks_quiet_subscription_without_repeated_sample() -> None:
    scene = Scene(ON_CHANGE)
    scene.sample(1, b"same")
    scene.passes(31 * SECOND)
    (add,) = scene.asked
    scene.answer(add, granted(2))
    scene.answer(scene.asked[1], bytes(4))
    assert scene.station.router.interruptions() == []
    assert scene.sample(2, b"same") == []
    (sample,) = scene.sample(2, b"else")
    assert sample.body == stream((5, {1: b"else"}))
    assert scene.station.events() == []


def test_quiet_subscriptions_are_interrupted_when_their_server_does_not_answer() -> None:
    scene = Scene(CYCLIC, CYCLIC, CYCLIC)
    scene.passes(3 * SECOND)
    assert scene.station.router.interruptions() == []
    scene.answer(scene.asked[0], b"", 0x1B)
    (missing,) = scene.station.router.interruptions()
    where = "far (10.0.0.6 by link) or from behind it"
    assert (missing.number, missing.why) == (3, f"error 0x1b (host unreachable) from {where}")


def test_others_of_a_server_are_checked_when_it_has_forgotten_one() -> None:
    scene = Scene(CYCLIC, ON_CHANGE)
    scene.passes(3 * SECOND)
    (add,) = scene.asked
    scene.answer(add, granted(1))  # the handle that it had: nothing is to be deleted
    scene.sample(1)
    scene.passes(3 * SECOND)
    scene.answer(scene.asked[0], granted(8))
    scene.answer(scene.asked[1], (0x714).to_bytes(4, "little"))
    scene.passes(SECOND)
    assert [AddNotification.decode(each.body).mode for each in scene.asked] == [4]


def test_later_router_ends_subscription_at_previous_router() -> None:
    scene = Scene()
    marked = ADD._replace(invoke_id=InvokeIds(7).allocate(()), body=CYCLIC.encode())
    scene.station.replied(scene.station.forwarded(marked, ONE).answer(granted(1)), LINK)
    (end,) = scene.lose_hop()
    assert end.body == END
    assert scene.passes(SECOND) == []
    assert scene.asked == []


def test_hop_with_another_restart_index_has_forgotten_its_subscriptions() -> None:
    scene = Scene(CYCLIC, is_probing=True)

    def probe(restart_index: int) -> None:
        scene.station.now_ns += SECOND
        scene.asked.clear()
        scene.take(scene.station.router.handle_timeout(scene.station.now_ns))
        (state,) = [each for each in scene.asked if each.command == AmsCommand.READ]
        assert state.target == f"{FAR}:{SYSTEM_PORT}"
        scene.sample(1)  # the hop is not silent at any time
        found = struct.pack("<IIHHH", 0, 16, 5, 0, restart_index) + bytes(10)
        scene.answer(state, found)

    for restart_index in (7, 7):
        probe(restart_index)
        assert scene.station.router.interruptions() == []
    probe(8)
    (missing,) = scene.station.router.interruptions()
    assert missing.why == "its router was started again"


def test_request_to_a_hop_that_was_started_again_is_answered() -> None:
    scene = Scene(CYCLIC, is_probing=True)
    for restart_index in (7, 8):
        scene.passes(SECOND)
        (state,) = [each for each in scene.asked if each.command == AmsCommand.READ]
        request = ADD._replace(command=AmsCommand.READ_STATE, invoke_id=restart_index, body=b"")
        onward = scene.station.forwarded(request, ONE)
        found = struct.pack("<IIHHH", 0, 16, 5, 0, restart_index) + bytes(10)
        assert scene.answer(state, found) == []
        assert scene.answer(onward, bytes(8)) == [request.answer(bytes(8))]
    assert scene.station.router.interruptions()[0].why == "its router was started again"


def test_hop_that_was_lost_is_not_lost_again_by_its_restart_index() -> None:
    scene = Scene(CYCLIC, is_probing=True)

    def tell(restart_index: int) -> None:
        scene.passes(SECOND)
        (state,) = [each for each in scene.asked if each.command == AmsCommand.READ]
        scene.answer(state, struct.pack("<IIHHH", 0, 16, 5, 0, restart_index) + bytes(10))

    tell(7)
    scene.lose_hop()
    scene.passes(0)
    scene.answer(next(each for each in scene.asked if each.command == ADD_NOTIFICATION), granted(8))
    tell(9)
    assert scene.station.router.interruptions() == []


def test_hop_without_restart_index_is_probed_once() -> None:
    scene = Scene(CYCLIC, is_probing=True)
    scene.passes(SECOND)
    (state,) = [each for each in scene.asked if each.command == AmsCommand.READ]
    scene.answer(state, (0x702).to_bytes(4, "little") + bytes(4))
    scene.sample(1)
    scene.passes(SECOND)
    assert not [each for each in scene.asked if each.command == AmsCommand.READ]


def test_hop_that_is_up_again_is_probed_for_restart_index() -> None:
    scene = Scene(CYCLIC, is_probing=True)
    scene.passes(SECOND)
    (state,) = [each for each in scene.asked if each.command == AmsCommand.READ]
    scene.answer(state, b"", 6)  # its system service has not started yet
    scene.lose_hop()
    scene.passes(0)
    scene.answer(next(each for each in scene.asked if each.command == ADD_NOTIFICATION), granted(8))
    scene.passes(SECOND)
    assert [each for each in scene.asked if each.command == AmsCommand.READ]


def test_restoration_waits_longer_for_a_server_that_does_not_answer_in_time() -> None:
    scene = Scene(CYCLIC)
    scene.lose_hop()
    scene.passes(0)
    for limit_ns in (
        TIMEOUT_NS,
        2 * TIMEOUT_NS,
        RouterLimits().timeout_ns,
        RouterLimits().timeout_ns,
    ):
        (add,) = scene.asked
        scene.passes(limit_ns - 1)
        assert scene.asked == []
        scene.passes(1)
        scene.passes(RETRY_NS)
    (add,) = scene.asked
    scene.passes(RouterLimits().timeout_ns - 1)
    scene.answer(add, granted(7))
    assert [each.body for each in scene.sample(7)] == [stream((5, {1: b"data"}))]


def test_symbol_handle_of_a_refused_subscription_is_given_back() -> None:
    scene, _ = lose_symbol()
    scene.answer(scene.asked[0], struct.pack("<III", 0, 4, 66))
    scene.answer(scene.asked[1], b"", 6)  # its server is starting
    given_back = scene.asked[2]
    assert given_back.command == AmsCommand.WRITE
    assert given_back.body == struct.pack("<IIII", 0xF006, 0, 4, 66)


def test_subscriptions_that_were_deleted_are_not_kept_for_their_checks() -> None:
    scene = Scene()
    seldom = AddNotification(0x4040, 8, 4, TransMode.SERVER_CYCLE, 0, 0xFFFF_FFFF)
    for number in range(1, 1500):
        add = ADD._replace(invoke_id=number, body=seldom.encode())
        scene.station.replied(scene.station.forwarded(add, ONE).answer(granted(number)), LINK)
        delete = ADD._replace(
            command=DELETE_NOTIFICATION, invoke_id=number, body=number.to_bytes(4, "little")
        )
        scene.take(scene.station.give(delete, ONE))
        scene.answer(scene.asked.pop(), bytes(4))
    kept = sum(isinstance(each, Subscription) for each in gc.get_objects())
    assert kept < 1000


def test_hop_with_subscriptions_is_awaited() -> None:
    scene = Scene(CYCLIC)
    assert scene.station.router.is_awaited(LINK)
    scene.station.router.connection_closed(*ONE, 0)
    scene.station.router.handle_timeout(10 * SECOND)
    assert not scene.station.router.is_awaited(LINK)


def test_location_counts_interrupted_subscriptions() -> None:
    scene = Scene(CYCLIC, CYCLIC)
    scene.lose_hop()
    header, _ = decode(ADD)
    found = scene.station.router.locate(header, ONE)
    assert (found.interrupted, found.interrupted_at_ns) == (2, 0)


def decode(packet: Ams) -> tuple[AmsHeader, memoryview]:
    return decode_packet(packet.octets())


def test_handle_that_the_server_gives_again_is_that_of_the_new_subscription() -> None:
    scene = Scene(CYCLIC)
    again = ADD._replace(invoke_id=2, body=ON_CHANGE.encode())
    onward = scene.station.forwarded(again, ONE)
    _, answer = only_reply(scene.station.give(onward.answer(granted(1)), LINK))
    handle = int.from_bytes(answer.body[4:], "little")
    assert handle != 1
    assert scene.sample(1)[0].body == stream((5, {handle: b"data"}))
    assert scene.station.router.interruptions()[0].why == "its server was started again"
