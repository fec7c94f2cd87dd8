"""Network of AMS routers behind an MQTT broker."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from eap.ams.mqtt import network as mqtt_network
from eap.ams.mqtt import network as mqtt_peers
from eap.ams.mqtt.messages import FIRST_PORT, Info, encode_info
from eap.ams.mqtt.network import (
    CONFIRM_NS,
    EXPIRY_NS,
    MAX_PACKET,
    REFRESH_NS,
    Action,
    Change,
    Drop,
    Dropped,
    HopDown,
    HopUp,
    MqttNetwork,
    PacketReceived,
    PeerClosed,
    Peers,
    Publish,
    Subscribe,
    Warn,
)
from eap.ams.routes import Origin, Route, RouteTable
from eap.ams.spec import MqttSpec
from eap.ids import Endpoint, NetId
from tests.support.ams import NOTIFICATION, Ams, parse

OWN, FAR, NEAR = (NetId.parse(each) for each in ("5.1.1.1.1.1", "6.1.1.1.1.1", "6.1.1.1.9.1"))
DOOR = "mqtt:hall"
HERE, GONE = Info("far", is_online=True), Info("far", is_online=False)


def peers_with(table: RouteTable | None = None) -> Peers:
    return Peers(OWN, DOOR, RouteTable() if table is None else table)


def test_peers_report_router_online_and_offline() -> None:
    peers = peers_with()
    told = [peers.update(FAR, each, 1) for each in (HERE, HERE, GONE, GONE, HERE)]
    assert told == [Change.UP, Change.NOTHING, Change.DOWN, Change.NOTHING, Change.UP]
    assert len(peers) == 1


def test_peers_report_offline_for_router_never_online() -> None:
    assert peers_with().update(FAR, GONE, 1) is Change.DOWN


def test_route_is_learned_and_expires() -> None:
    table = RouteTable()
    peers_with(table).update(FAR, HERE, 5)
    (route,) = table
    assert route == Route(
        FAR, "far", Endpoint(DOOR, str(FAR)), Origin.LEARNED, 4,
        expires_at_ns=5 + EXPIRY_NS, is_probed=False,
    )  # fmt: skip
    assert table.expire(5 + EXPIRY_NS) == [route]


def test_learned_route_is_renewed_in_time_and_for_new_name() -> None:
    table = RouteTable()
    peers = peers_with(table)
    peers.update(FAR, HERE, 0)
    version = table.version
    peers.update(FAR, HERE, REFRESH_NS // 3)
    assert table.version == version
    peers.update(FAR, HERE, REFRESH_NS)
    assert [each.expires_at_ns for each in table] == [REFRESH_NS + EXPIRY_NS]
    peers.update(FAR, HERE._replace(name=""), REFRESH_NS + 1)
    assert [each.name for each in table] == [str(FAR)]


def test_nothing_is_learned_that_is_not_to_be_learned() -> None:
    table = RouteTable([Route(FAR, "configured", Endpoint(DOOR, str(FAR)))])
    peers = peers_with(table)
    assert peers.update(FAR, HERE, 0) is Change.UP
    peers.update(NEAR, HERE._replace(is_unidirectional=True), 0)
    assert [each.origin for each in table] == [Origin.STATIC]
    table = RouteTable()
    assert Peers(OWN, DOOR, table, learns=False).update(FAR, HERE, 0) is Change.UP
    assert not len(table)


def test_hops_that_nothing_probes_are_awaited() -> None:
    table = RouteTable([
        Route(FAR, "far", Endpoint(DOOR, str(FAR)), is_probed=False),
        Route(NEAR, "near", Endpoint(DOOR, str(NEAR)), is_probed=False),
        Route(OWN, "probed", Endpoint(DOOR, str(OWN))),
        Route(OWN, "elsewhere", Endpoint("mqtt:line", str(OWN)), is_probed=False),
    ])  # fmt: skip
    peers = peers_with(table)
    assert peers.missing() == [str(FAR), str(NEAR)]
    peers.update(FAR, HERE, 0)
    peers.update(NetId.parse("7.1.1.1.1.1"), HERE, 0)
    assert peers.missing() == [str(NEAR)]
    peers.update(FAR, GONE, 0)
    assert peers.missing() == [str(FAR), str(NEAR)]


def test_other_routers_of_this_computer_get_their_own_net_id_only() -> None:
    table = RouteTable()
    peers_with(table).update(NetId.parse("5.1.1.1.7.1"), HERE, 0)
    assert [each.octets for each in table] == [6]


def test_silent_routers_are_forgotten_and_their_routes_too() -> None:
    table = RouteTable()
    peers = peers_with(table)
    peers.update(FAR, HERE, 1)
    peers.update(NEAR, GONE, 2)
    third = NetId.parse("7.1.1.1.1.1")
    peers.update(third, HERE, 10)
    assert peers.forget(5, 12) == ([FAR], [NEAR])
    assert len(peers) == 1
    assert [each.net_id for each in table.expire(12)] == [FAR]
    assert [each.net_id for each in table] == [third]


def test_added_route_survives_expiry_of_learned_one() -> None:
    table = RouteTable()
    peers = peers_with(table)
    peers.update(FAR, HERE, 1)
    table.add(Route(FAR, "added", Endpoint(DOOR, str(FAR)), Origin.ADDED))
    peers.forget(5, 12)
    assert table.expire(12) == []
    assert [each.name for each in table] == ["added"]


def test_sender_is_behind_the_router_that_is_nearest() -> None:
    peers = peers_with()
    assert peers.address_of(NetId.parse("6.1.1.1.9.7")) == "6.1.1.1.9.7"
    peers.update(FAR, HERE, 0)
    peers.update(NEAR, HERE, 0)
    assert peers.address_of(NEAR) == "6.1.1.1.9.1"
    assert peers.address_of(NetId.parse("6.1.1.1.9.7")) == "6.1.1.1.9.1"
    assert peers.address_of(NetId.parse("6.1.1.1.2.1")) == "6.1.1.1.1.1"
    peers.update(FAR, GONE, 0)
    assert peers.address_of(NetId.parse("6.1.1.1.2.1")) == "6.1.1.1.9.1"
    assert peers.address_of(NetId.parse("6.1.2.1.2.1")) == "6.1.2.1.2.1"


def test_peers_ignore_routers_beyond_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt_peers, "MAX_PEERS", 1)
    table = RouteTable()
    peers = peers_with(table)
    peers.update(FAR, HERE, 0)
    assert peers.update(NEAR, HERE, 0) is Change.IGNORED
    assert peers.update(FAR, GONE, 0) is Change.DOWN
    assert len(table) == 1


OWN_ID, FAR_ID = "5.1.1.1.1.1", "6.1.1.1.1.1"
DEVICE, TOOL = f"{OWN_ID}:10000", f"{FAR_ID}:33000"
REQUEST = Ams(DEVICE, TOOL).octets()
SECOND = 1_000_000_000


class Place:
    """A router's place in a network, and what came of what it was told."""

    def __init__(self, **settings: object) -> None:
        spec = MqttSpec(network="hall", host="broker", **settings)
        self.table = RouteTable()
        self.network = MqttNetwork(
            spec, NetId.parse(OWN_ID), "island-01", transport="mqtt:hall", table=self.table
        )
        self.now_ns = 100 * SECOND
        self.first = self.network.connected(self.now_ns)

    def hear(self, topic: str, payload: bytes, **more: bool) -> list[Action]:
        return self.network.receive_message(f"hall/{topic}", payload, self.now_ns, **more)

    def hear_of(self, net_id: str, info: Info, **more: bool) -> list[Action]:
        return self.hear(f"{net_id}/info", encode_info(info), **more)

    def asked(self, payload: bytes, topic: str = "ams") -> list[Action]:
        return self.hear(f"{OWN_ID}/{topic}", payload)

    def wait(self, seconds: float) -> list[Action]:
        self.now_ns += int(seconds * SECOND)
        return self.network.handle_timeout(self.now_ns)


def own_info(*, is_retained: bool = True) -> Publish:
    payload = encode_info(Info("island-01", is_online=True))
    return Publish(f"hall/{OWN_ID}/info", payload, 2, is_retained)


def test_network_connected_subscribes_then_publishes_info() -> None:
    place = Place()
    assert place.first == [Subscribe((f"hall/{OWN_ID}/ams/#", "hall/+/info")), own_info()]
    will = place.network.will()
    assert (will.topic, will.qos, will.is_retained) == (f"hall/{OWN_ID}/info", 2, True)
    assert b">false<" in will.payload
    place.network.disconnected()
    assert place.network.next_timeout() is None
    assert place.network.handle_timeout(1 << 60) == []
    assert place.network.connected(1 << 60) == place.first


def test_network_info_makes_hop_up_and_down() -> None:
    place = Place()
    assert place.hear_of(FAR_ID, HERE) == [HopUp(FAR_ID)]
    assert place.hear_of(FAR_ID, HERE) == []
    assert [each.name for each in place.table] == ["far"]
    assert place.hear_of(FAR_ID, GONE) == [
        HopDown(FAR_ID, "its info says that it is offline"),
        PeerClosed(FAR_ID),
    ]


def test_network_reports_routers_missing_after_reconnect() -> None:
    place = Place()
    place.hear_of(FAR_ID, HERE)
    place.hear_of("7.1.1.1.1.1", GONE)
    place.hear_of("8.1.1.1.1.1", HERE)
    place.network.disconnected()
    place.now_ns += SECOND
    place.network.connected(place.now_ns)
    place.hear_of("8.1.1.1.1.1", HERE)
    assert place.network.next_timeout() == place.now_ns + CONFIRM_NS
    assert place.wait(29) == []
    assert place.wait(1) == [
        HopDown(FAR_ID, "it has sent no info for too long"), PeerClosed(FAR_ID), HopUp(FAR_ID),
        HopUp("7.1.1.1.1.1"), Subscribe(("hall/+/info",)),
    ]  # fmt: skip
    place.table.expire(place.now_ns)
    assert [str(each.net_id) for each in place.table] == ["8.1.1.1.1.1"]


def test_network_configured_hop_is_down_until_its_info() -> None:
    place = Place()
    far = NetId.parse(FAR_ID)
    place.table.add(Route(far, "far", Endpoint("mqtt:hall", FAR_ID), is_probed=False))
    place.network.disconnected()
    missing = HopDown(FAR_ID, "it has sent no info yet")
    assert place.network.connected(place.now_ns) == [missing, *place.first]
    assert place.wait(30)[0] == missing
    assert place.hear_of(FAR_ID, HERE) == [HopUp(FAR_ID)]
    place.wait(REFRESH_NS / SECOND)
    place.wait(REFRESH_NS / SECOND)
    gone = place.wait(REFRESH_NS / SECOND)
    assert gone[:4] == [
        HopDown(FAR_ID, "it has sent no info for too long"), PeerClosed(FAR_ID),
        HopUp(FAR_ID), missing,
    ]  # fmt: skip


def test_network_requests_retained_infos_periodically() -> None:
    place = Place()
    place.wait(30)
    place.hear_of(FAR_ID, HERE)
    assert place.network.next_timeout() == place.now_ns + REFRESH_NS
    assert place.wait(120) == [Subscribe(("hall/+/info",))]
    place.wait(120)
    assert place.wait(120)[0] == HopDown(FAR_ID, "it has sent no info for too long")


def test_network_without_retain_answers_new_router_with_info() -> None:
    place = Place(no_retain=True)
    assert place.first[1] == own_info(is_retained=False)
    assert not place.network.will().is_retained
    assert place.hear_of(FAR_ID, HERE) == [HopUp(FAR_ID)]  # told a moment ago: soon again
    assert place.network.next_timeout() == place.now_ns + SECOND
    assert place.wait(1) == [own_info(is_retained=False)]
    place.now_ns += SECOND
    assert place.hear_of(FAR_ID, HERE) == []  # that was its answer
    assert place.hear_of("7.1.1.1.1.1", HERE)[1:] == [own_info(is_retained=False)]
    place.now_ns += 30 * SECOND
    assert place.hear_of(FAR_ID, HERE) == [own_info(is_retained=False)]
    assert own_info(is_retained=False) in place.wait(REFRESH_NS / SECOND)


def test_two_routers_without_retained_messages_meet_and_fall_silent() -> None:
    one, two = Place(no_retain=True), Place(no_retain=True)
    two.network = MqttNetwork(
        MqttSpec(network="hall", host="broker", no_retain=True),
        NetId.parse(FAR_ID), "island-02", transport="mqtt:hall", table=two.table,
    )  # fmt: skip
    two.now_ns += 60 * SECOND
    one.now_ns = two.now_ns
    sent = {two: list(two.network.connected(two.now_ns)), one: []}
    count = 0
    for _ in range(20):
        for place, other in ((one, two), (two, one)):
            for message in [each for each in sent[other] if isinstance(each, Publish)]:
                count += 1
                sent[place] += place.network.receive_message(
                    message.topic, message.payload, place.now_ns
                )
            sent[other] = []
        for place in (one, two):
            place.now_ns += SECOND // 2
            sent[place] += place.network.handle_timeout(place.now_ns)
    assert [str(each.net_id) for each in one.table] == [FAR_ID]
    assert [str(each.net_id) for each in two.table] == [OWN_ID]
    assert count <= 4  # of the one that was there the first time, one is by the clock


def test_late_will_of_an_earlier_connection_is_corrected() -> None:
    place = Place()
    will = place.network.will()
    assert place.network.receive_message(will.topic, will.payload, place.now_ns) == []
    assert place.wait(1) == [own_info()]
    place.now_ns += SECOND
    assert place.network.receive_message(will.topic, b"", place.now_ns) == [own_info()]


def test_second_router_with_the_net_id_is_named_once() -> None:
    place = Place()
    assert place.hear_of(OWN_ID, Info("island-01", is_online=True)) == []
    assert place.hear_of(OWN_ID, Info("before", is_online=True), is_retained=True) == []
    (warning,) = place.hear_of(OWN_ID, Info("twin", is_online=True))
    assert warning == Warn(
        f"'twin' announces the NetID {OWN_ID}, which is this station's;"
        " each router of a network needs one of its own"
    )
    assert place.hear_of(OWN_ID, Info("twin", is_online=True)) == []


@pytest.mark.parametrize("prefix", [b"", bytes.fromhex("0000 25000000")], ids=["bare", "prefixed"])
def test_packet_arrives_and_its_answer_has_its_form(prefix: bytes) -> None:
    place = Place()
    asked = Ams(DEVICE, TOOL, body=b"asked")
    assert place.asked(prefix + asked.octets()) == [PacketReceived(asked.octets(), FAR_ID)]
    answer = asked.answer(b"gives").octets()
    assert place.network.message_for(FAR_ID, answer) == Publish(
        f"hall/{FAR_ID}/ams/res", prefix + answer, 0
    )


@pytest.mark.parametrize(("is_prefixed", "length"), [(False, 32), (True, 38)])
def test_network_unknown_sender_gets_configured_packet_form(is_prefixed: bool, length: int) -> None:
    place = Place(is_prefixed=is_prefixed, qos=1)
    sent = place.network.message_for(FAR_ID, Ams(TOOL, DEVICE).octets())
    assert (sent.topic, len(sent.payload), sent.qos) == (f"hall/{FAR_ID}/ams", length, 1)
    note = Ams(TOOL, DEVICE, command=NOTIFICATION).octets()
    assert place.network.message_for(FAR_ID, note).topic == f"hall/{FAR_ID}/ams/res"


def test_network_forwards_client_request_and_answer() -> None:
    place = Place()
    asked = Ams(f"{FAR_ID}:851", "192.168.0.9.1.1:33000")
    sent = parse(place.network.message_for(FAR_ID, asked.octets()).payload)
    assert sent.source == f"{OWN_ID}:{FIRST_PORT}"
    (arrived,) = place.asked(sent.answer().octets(), "ams/res")
    assert isinstance(arrived, PacketReceived)
    assert parse(arrived.packet) == asked.answer()
    note = sent.answer()._replace(command=NOTIFICATION, flags=4)
    for topic in ("ams", "ams/res"):
        (arrived,) = place.asked(note.octets(), topic)
        assert isinstance(arrived, PacketReceived)
        assert parse(arrived.packet).target == asked.source


def test_answers_go_to_the_router_that_the_sender_is_behind() -> None:
    place = Place()
    asked = Ams(DEVICE, "6.1.1.1.3.1:1001").octets()
    assert place.asked(asked) == [PacketReceived(asked, "6.1.1.1.3.1")]
    place.hear_of(FAR_ID, HERE)
    assert place.asked(asked) == [PacketReceived(asked, FAR_ID)]


def test_network_unidirectional_station_publishes_it() -> None:
    place = Place(is_unidirectional=True)
    assert b'unidirectional="true"' in place.first[1].payload


def test_too_long_a_request_is_answered_and_too_long_an_answer_is_not() -> None:
    place = Place()
    asked = Ams(DEVICE, TOOL, body=bytes(MAX_PACKET))
    dropped, warning, refusal = place.asked(asked.octets())
    assert dropped == Dropped(Drop.LENGTH)
    assert "too long a packet" in warning.text
    assert parse(refusal.payload) == asked.answer(b"", 0xE)
    assert place.asked(asked._replace(flags=6).octets()) == [dropped]
    assert place.asked(asked.answer(bytes(MAX_PACKET)).octets(), "ams/res") == [dropped]


@pytest.mark.parametrize(
    ("topic", "payload", "more", "reason", "text"),
    [
        (f"{OWN_ID}/ams", b"short", {}, Drop.BROKEN, "broken packet"),
        (f"{FAR_ID}/info", b"<info>", {}, Drop.BROKEN, "broken info"),
        (f"{FAR_ID}/ams", REQUEST, {}, Drop.TOPIC, "unknown topic"),
        ("nonsense", b"", {}, Drop.TOPIC, "unknown topic"),
        (f"{OWN_ID}/ams/res", REQUEST, {}, Drop.TOPIC, "request on the topic for answers"),
        (f"{OWN_ID}/ams", REQUEST, {"is_retained": True}, Drop.TOPIC, "retained packet"),
    ],
)
def test_network_counts_dropped_messages_and_warns_once(
    topic: str, payload: bytes, more: dict[str, bool], reason: Drop, text: str
) -> None:
    place = Place()
    dropped, warning = place.hear(topic, payload, **more)
    assert dropped == Dropped(reason)
    assert warning.text.startswith(f"{text}: ")
    assert place.hear(topic, payload, **more) == [dropped]


def test_routers_and_senders_have_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt_network, "MAX_SENDERS", 2)
    monkeypatch.setattr("eap.ams.mqtt.network.MAX_PEERS", 1)
    place = Place()
    place.hear_of(FAR_ID, HERE)
    assert place.hear_of("7.1.1.1.1.1", HERE)[0] == Dropped(Drop.FULL)
    for number in (7, 8):
        assert len(place.asked(Ams(DEVICE, f"{number}.1.1.1.1.1:1").octets())) == 1
    closed, _ = place.asked(Ams(DEVICE, "9.1.1.1.1.1:1").octets())
    assert closed == PeerClosed("7.1.1.1.1.1")


def test_network_forgets_sender_without_info_after_an_hour() -> None:
    place = Place()
    place.asked(Ams(DEVICE, "7.1.1.1.1.1:1").octets())
    place.now_ns += 1800 * SECOND
    place.asked(Ams(DEVICE, "8.1.1.1.1.1:1").octets())
    assert PeerClosed("7.1.1.1.1.1") not in place.wait(1799)
    place.now_ns += REFRESH_NS
    assert place.wait(1)[0] == PeerClosed("7.1.1.1.1.1")
    assert PeerClosed("8.1.1.1.1.1") not in place.wait(REFRESH_NS / SECOND)


@given(st.sampled_from([f"{OWN_ID}/ams", f"{OWN_ID}/ams/res", f"{FAR_ID}/info", f"{OWN_ID}/info"]),
       st.binary(max_size=80), st.booleans())  # fmt: skip
def test_no_message_raises(topic: str, payload: bytes, is_retained: bool) -> None:
    place = Place()
    place.hear(topic, payload, is_retained=is_retained)


class AnyOrder(RuleBasedStateMachine):
    """Whatever is told in whatever order, hops and routes are those of who is there."""

    def __init__(self) -> None:
        super().__init__()
        self.place = Place()
        self.told_at: dict[str, int] = {}
        self.down: set[str] = set()
        self.is_connected = True

    def do(self, actions: list[Action]) -> None:
        for action in actions:
            if isinstance(action, HopDown):
                self.down.add(action.address)
            elif isinstance(action, HopUp):
                self.down.discard(action.address)
            elif isinstance(action, Publish):
                assert self.is_connected

    @rule(number=st.integers(1, 4), is_online=st.booleans(), is_retained=st.booleans())
    def update(self, number: int, is_online: bool, is_retained: bool) -> None:
        if not self.is_connected:
            return
        net_id = f"6.1.1.1.{number}.1"
        self.do(self.place.hear_of(net_id, Info("x", is_online), is_retained=is_retained))
        self.told_at.pop(net_id, None)
        if is_online:
            self.told_at[net_id] = self.place.now_ns
        assert (net_id in self.down) == (not is_online)

    @rule()
    def lose(self) -> None:
        self.place.network.disconnected()
        self.is_connected = False

    @rule()
    def connect(self) -> None:
        self.is_connected = True
        self.do(self.place.network.connected(self.place.now_ns))

    @rule(seconds=st.sampled_from([1, 31, 121, 301]))
    def elapse(self, seconds: int) -> None:
        self.do(self.place.wait(seconds))
        self.place.table.expire(self.place.now_ns)

    @invariant()
    def time_goes_on(self) -> None:
        due_ns = self.place.network.next_timeout()
        assert (due_ns is not None) == self.is_connected

    @invariant()
    def routes_are_of_who_was_there(self) -> None:
        oldest = self.place.now_ns - EXPIRY_NS
        for route in self.place.table:
            address = route.hop.connection
            known = self.told_at.get(address, -1) > oldest
            assert known or address in self.down


TestAnyOrder = AnyOrder.TestCase
