"""A link to a real broker: what it says first, broken connections, and who is not let in."""

from __future__ import annotations

import asyncio
import logging
import socket
import sys
import time
from collections.abc import Awaitable, Callable
from contextlib import ExitStack, asynccontextmanager, suppress

import pytest
from aiomqtt import Message

from eap.ams.mqtt.network import Publish, Subscribe
from eap.ams.spec import MqttSpec, TlsSpec
from eap.errors import EnvironmentalError
from eap.net import mqtt, mqttclient
from eap.net.mqtt import Handlers, MqttLink
from tests.support.eventually import eventually, settle
from tests.support.mosquitto import broker, write_certificates, write_passwords

pytestmark = [pytest.mark.net, pytest.mark.mosquitto]

ADDRESS = "127.0.3.40"
NAME = "MQTT broker 127.0.3.40:1883"
WILL = Publish("hall/1/info", b"gone", 2, is_retained=True)
HELLO = Publish("hall/1/info", b"here", 2, is_retained=True)


class Peer:
    """A link, and what it told."""

    def __init__(self, name: str = "one", **settings: object) -> None:
        self.heard: list[tuple[str, bytes, bool]] = []
        self.lost: list[str] = []
        self.connections = 0
        spec = MqttSpec(network="hall", **{"host": ADDRESS, **settings})
        self.overruns = 0
        self.link = MqttLink(
            spec, name, will=lambda: WILL,
            handlers=Handlers(self._connected, self.lost.append, self._hear, self._overrun),
        )  # fmt: skip

    def _connected(self) -> None:
        self.connections += 1
        assert self.link.send(Subscribe(("hall/#",))) is None
        assert self.link.send(HELLO) is None

    def _overrun(self) -> None:
        self.overruns += 1

    def _hear(self, topic: str, payload: bytes, is_retained: bool) -> None:
        self.heard.append((topic, payload, is_retained))


@asynccontextmanager
async def running(*peers: Peer):
    tasks = [asyncio.ensure_future(peer.link.run()) for peer in peers]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def play(story: Callable[[], Awaitable[None]]) -> None:
    asyncio.run(story())


@pytest.fixture
def clients(monkeypatch):
    """Clients that links make, one for each attempt to connect."""
    made = []
    make = mqttclient.make_client

    def make_noted(*args, **more):
        made.append(make(*args, **more))
        return made[-1]

    monkeypatch.setattr(mqttclient, "make_client", make_noted)
    return made


def test_mqtt_link_subscribes_publishes_and_disconnects(tmp_path):
    async def story():
        one, two = Peer(), Peer("two")
        async with running(two):
            await eventually(lambda: two.heard)
            async with running(one):
                await eventually(lambda: ("hall/1/info", b"here", True) in one.heard)
                for number in range(100):
                    message = Publish("hall/2/ams", b"%d" % number, 0)
                    assert one.link.send(message) is None
                await eventually(lambda: len(two.heard) >= 102)
                numbers = [each for each in two.heard if each[0] == "hall/2/ams"]
                assert numbers == [("hall/2/ams", b"%d" % n, False) for n in range(100)]
                one.link.send(Publish("hall/2/ams", b"sure", 2))
                await eventually(lambda: two.heard[-1] == ("hall/2/ams", b"sure", False))
            await eventually(lambda: two.heard[-1] == ("hall/1/info", b"gone", False))

    with broker(tmp_path, ADDRESS):
        play(story)


def test_link_comes_back_with_its_broker(tmp_path, caplog, clients):
    async def story(server):
        peer = Peer()
        assert "no connection to MQTT broker 127.0.3.40:1883" in peer.link.send(HELLO)
        async with running(peer):
            await eventually(lambda: "refused" in caplog.text)
            server.start()
            await eventually(lambda: peer.heard)
            server.stop()
            await eventually(lambda: peer.lost)
            # A broker that ends with octets unread resets the connection.
            broken = ("the connection broke", "failed to receive on socket: [Errno 104]")
            assert peer.lost[0].startswith(
                tuple(f"no connection to {NAME}: {each}" for each in broken)
            )
            assert len(peer.lost) == 1
            assert peer.link.send(HELLO).startswith("no connection")
            tried = len(clients)
            await eventually(lambda: len(clients) >= tried + 2)
            server.start()
            await eventually(lambda: peer.connections == 2 and peer.heard[1:])
        assert caplog.text.count("refused") <= 2  # once each time that it is away

    caplog.set_level(logging.INFO)
    with broker(tmp_path, ADDRESS) as server:
        server.stop()
        play(lambda: story(server))


def test_mqtt_login_errors_name_user(tmp_path, caplog):
    right, wrong = tmp_path / "right", tmp_path / "wrong"
    right.write_text("secret\n")
    wrong.write_text("guess\n")

    async def story():
        known = Peer("known", user="island", password_file=str(right))
        other = Peer("other", user="island", password_file=str(wrong))
        nobody, lost = Peer("nobody"), Peer("lost", user="island", password_file="/nowhere")
        async with running(known, other, nobody, lost):
            await eventually(lambda: known.heard)
            await eventually(lambda: caplog.text.count("trying again") >= 3)
        assert not other.connections + nobody.connections + lost.connections

    passwords = write_passwords(tmp_path, island="secret")
    with broker(tmp_path, ADDRESS, "allow_anonymous false", f"password_file {passwords}"):
        play(story)
    name = "MQTT broker 127.0.3.40:1883: "
    assert (
        f"{name}user 'island' or the password is rejected: check 'user' and 'password_file';"
        " trying again"
    ) in caplog.text
    assert f"{name}a login is required: set 'user' and 'password_file'" in caplog.text
    assert "/nowhere: No such file or directory" in caplog.text
    assert "secret" not in caplog.text
    assert "guess" not in caplog.text


def test_mqtt_tls_checks_names_of_both_ends(tmp_path, caplog, monkeypatch):
    # aiomqtt waits that long for an answer, although the connection is gone.
    monkeypatch.setattr(mqttclient, "ANSWER_S", 1.0)
    files = write_certificates(tmp_path, ADDRESS)
    mine = TlsSpec(str(files["ca"]), str(files["client"]), str(files["client_key"]))
    settings = (
        "allow_anonymous true", "require_certificate true", "use_identity_as_username true",
        f"cafile {files['ca']}", f"certfile {files['broker']}", f"keyfile {files['broker_key']}",
    )  # fmt: skip

    async def story(server):
        good = Peer("good", port=8883, tls=mine)
        stranger = Peer("stranger", port=8883, tls=TlsSpec())
        nobody = Peer("nobody", port=8883, tls=TlsSpec(str(files["ca"])))
        async with running(good, stranger, nobody):
            await eventually(lambda: good.heard)
            await eventually(lambda: "certificate verify failed" in caplog.text)
            await eventually(lambda: "certificate required" in caplog.text)
        assert not nobody.connections + stranger.connections
        assert "as good (p5, c1, k10, u'island-01')" in server.log.read_text()

    with broker(tmp_path, ADDRESS, *settings, port=8883) as server:
        play(lambda: story(server))


def test_mqtt_tls_rejects_other_name_unless_disabled(tmp_path, caplog):
    files = write_certificates(tmp_path, "127.0.3.99")
    settings = ("allow_anonymous true", f"certfile {files['broker']}",
                f"keyfile {files['broker_key']}")  # fmt: skip

    async def story():
        strict = Peer("strict", port=8883, tls=TlsSpec(str(files["ca"])))
        easy = Peer("easy", port=8883, tls=TlsSpec(str(files["ca"]), check_name=False))
        async with running(strict, easy):
            await eventually(lambda: easy.heard)
            await eventually(lambda: "IP address mismatch" in caplog.text)
        assert not strict.connections

    with broker(tmp_path, ADDRESS, *settings, port=8883):
        play(story)


def test_message_longer_than_any_packet_stays_with_the_broker(tmp_path):
    async def story():
        one, two = Peer(), Peer("two")
        async with running(one, two):
            await eventually(lambda: one.heard and two.heard)
            one.link.send(Publish("hall/2/ams", bytes(1 << 21), 0))
            one.link.send(Publish("hall/2/ams", b"after", 0))
            await eventually(lambda: ("hall/2/ams", b"after", False) in two.heard)
            assert max(len(payload) for _, payload, _ in two.heard) < 100
            assert two.connections == 1

    with broker(tmp_path, ADDRESS):
        play(story)


def test_topic_that_may_not_be_read_is_named(caplog):
    class Client:
        async def subscribe_all(self, topics):
            return topics[1:]

    async def story():
        await Peer().link._subscribe(Client(), Subscribe(("hall/#", "hall/+/info")))

    play(story)  # mosquitto grants everything, and then brings nothing
    assert [each.getMessage() for each in caplog.records] == [
        "MQTT broker 127.0.3.40:1883 does not let one read hall/+/info"
    ]


def test_too_much_at_once_is_not_taken(tmp_path, monkeypatch):
    monkeypatch.setattr(mqtt, "MAX_WAITING", 3)

    async def story():
        peer = Peer()
        async with running(peer):
            await eventually(lambda: peer.heard)
            said = [peer.link.send(Publish("hall/2/ams", b"x", 0)) for _ in range(5)]
            assert said == [None] * 3 + ["too much waits for MQTT broker 127.0.3.40:1883"] * 2

    with broker(tmp_path, ADDRESS):
        play(story)


def test_mqtt_overrun_is_reported():
    class Client:
        inbox = mqttclient.Inbox(1)

        @property
        async def messages(self):
            for _ in range(3):
                self.inbox.put_nowait(Message("hall/1/ams", b"x", 0, False, 0, None))
            yield self.inbox.get_nowait()

    async def story():
        peer = Peer()
        await peer.link._read(Client())
        assert (peer.overruns, peer.heard) == (2, [("hall/1/ams", b"x", False)])

    play(story)


def test_mqtt_writer_ends_with_a_connection_that_breaks_as_the_broker_confirms():
    """asyncio.wait_for returns the result if it comes together with the cancellation."""

    class Client:
        inbox = mqttclient.Inbox(1)

        def __init__(self) -> None:
            self.is_asked = asyncio.Event()

        async def subscribe_all(self, filters):
            self.is_asked.set()
            with suppress(asyncio.CancelledError):
                await asyncio.Event().wait()
            return []

        async def publish(self, *args, **more):
            raise AssertionError("sent by a connection that is lost")

        @property
        async def messages(self):
            await self.is_asked.wait()
            raise mqttclient.MqttError("the cable is cut")
            yield

    async def story():
        peer = Peer()
        with pytest.raises(mqttclient.MqttError, match="the cable"):
            async with asyncio.timeout(20):
                await peer.link._serve(Client(), WILL)

    play(story)


def test_mqtt_without_aiomqtt_error_has_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "aiomqtt", None)
    with pytest.raises(EnvironmentalError, match=r"pip install 'eap-appliance\[mqtt\]'"):
        Peer()


@pytest.mark.parametrize("refusal", [b"\x20\x02\0\x01", b"\x20\x03\0\x84\0", b""], ids=repr)
def test_mqtt_falls_back_to_3_1_1(refusal, caplog, monkeypatch):
    monkeypatch.setattr(mqttclient, "ANSWER_S", 0.3)
    versions = []

    async def serve(reader, writer):
        """As a broker that speaks MQTT 3.1.1: it refuses version 5, or just closes."""
        _, length = await reader.readexactly(2)
        connect = await reader.readexactly(length)
        versions.append(connect[6])
        if connect[6] == 4:
            writer.write(b"\x20\x02\0\0")
            kind, length = await reader.readexactly(2)
            subscribe = await reader.readexactly(length)
            assert kind == 0x82
            writer.write(b"\x90\x03" + subscribe[:2] + b"\2")
            writer.write(b"\x30\x0b\0\6hall/xhey")
            await reader.read()
        else:
            writer.write(refusal)
            await writer.drain()
        writer.close()

    async def story():
        peer = Peer()
        async with await asyncio.start_server(serve, ADDRESS, 1883), running(peer):
            await eventually(lambda: peer.heard)
            assert peer.heard == [("hall/x", b"hey", False)]

    play(story)
    assert versions == [5, 4]
    assert "speaks no MQTT 5: the longest message is its own affair" in caplog.text


def test_broker_behind_a_wall_does_not_hold_the_end_up(monkeypatch, caplog):
    probing, probe = asyncio.Event(), MqttLink._probe

    async def probe_noted(link):
        probing.set()
        await probe(link)

    monkeypatch.setattr(MqttLink, "_probe", probe_noted)
    monkeypatch.setattr(mqttclient, "CONNECT_S", 0.2)
    with socket.socket() as wall, ExitStack() as crowd:
        wall.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        wall.bind((ADDRESS, 1883))
        wall.listen(0)
        for _ in range(3):  # who comes after them gets no answer at all
            other = crowd.enter_context(socket.socket())
            other.setblocking(False)
            other.connect_ex((ADDRESS, 1883))

        async def story():
            async with running(Peer()):
                await eventually(lambda: "timed out; trying again" in caplog.text)
                await probing.wait()
                await settle()  # it waits for an answer

        began = time.monotonic()
        play(story)
        assert time.monotonic() - began < 2


def test_mqtt_duplicate_client_id_is_reported(tmp_path, caplog):
    async def story():
        one, two = Peer("same"), Peer("same")
        async with running(one):
            await eventually(lambda: one.heard)
            async with running(two):
                await eventually(
                    lambda: "has another client the name 'same' (client_id) too?" in caplog.text
                )

    with broker(tmp_path, ADDRESS):
        play(story)
