"""MQTT client beyond aiomqtt: bounded memory and time, and reasons in words."""

from __future__ import annotations

import asyncio
import socket
import ssl
import time

import pytest
from aiomqtt import Message
from aiomqtt.exceptions import MqttCodeError, MqttConnectError
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from eap.ams.mqtt.network import Publish
from eap.ams.spec import TlsSpec
from eap.net import mqttclient
from eap.net.mqttclient import Inbox, MqttClient, MqttError, describe, is_too_new, make_client

WILL = Publish("hall/1/info", b"gone", 2, is_retained=True)
REFUSED = ReasonCode(PacketTypes.CONNACK, "Not authorized")


def client(**more: object) -> MqttClient:
    settings = {"login": None, "tls": None, "will": WILL, "keepalive_s": 10, "is_old": False}
    return make_client("127.0.3.41", 1883, "one", **{**settings, **more})


def message(octets: int) -> Message:
    return Message("hall/1/ams", bytes(octets), 0, False, 0, None)


def in_loop(play):
    async def run():
        return play()

    return asyncio.run(run())


def test_mqtt_inbox_is_limited_by_number_and_bytes(monkeypatch):
    def play():
        inbox, lost = Inbox(3), []
        inbox.put_nowait(message(0))
        inbox.get_nowait()
        inbox.overrun = lambda: lost.append(1)
        for octets in (5, 1, 9, 7):
            inbox.put_nowait(message(octets))
        assert (inbox.qsize(), inbox.octets, len(lost)) == (3, 15, 1)
        inbox.get_nowait()
        monkeypatch.setattr(mqttclient, "MAX_INBOX_OCTETS", 10)
        inbox.put_nowait(message(1))
        assert (inbox.qsize(), inbox.octets, len(lost)) == (2, 10, 2)

    in_loop(play)


@pytest.mark.parametrize(
    "codes",
    [
        (2, 0x80),
        [ReasonCode(PacketTypes.SUBACK, each) for each in ("Granted QoS 2", "Not authorized")],
    ],
)
def test_refused_subscriptions_are_named(codes, monkeypatch):
    async def play():
        made = client()
        monkeypatch.setattr(made, "subscribe", lambda wanted: asyncio.sleep(0, codes))
        assert await made.subscribe_all(("a", "b")) == ["b"]

    asyncio.run(play())


@pytest.mark.parametrize(
    ("error", "user", "text"),
    [
        (MqttConnectError(REFUSED), "me", "user 'me' or the password is rejected"),
        (MqttConnectError(4), "me", "user 'me' or the password is rejected"),
        (MqttConnectError(REFUSED), "", "a login is required"),
        (MqttError("[Errno 111] Connection refused"), "", "[Errno 111] Connection refused"),
        (MqttError(), "", "MqttError"),
        (MqttCodeError(7), "", "The connection was lost"),
        (MqttCodeError(ReasonCode(PacketTypes.DISCONNECT, "Unspecified error")), "", "broke"),
    ],
)
def test_mqtt_error_is_described(error, user, text):
    assert text in describe(error, in_loop(client), user)


def test_mqtt_error_of_paho_log_is_described():
    made = in_loop(client)
    made._logger.warning("nobody hears this")
    made._logger.error("failed to receive on socket: %s", "bad certificate")
    text = describe(MqttError("Operation timed out"), made, "")
    assert text == "failed to receive on socket: bad certificate"


def test_broker_of_before_is_recognised():
    assert is_too_new(MqttConnectError(1))
    assert is_too_new(MqttError("Operation timed out"))
    assert not is_too_new(MqttConnectError(REFUSED))
    assert not is_too_new(MqttError("[Errno 111] Connection refused"))
    assert not is_too_new(MqttError("timed out"))


def test_mqtt_client_uses_requested_version():
    assert in_loop(client)._client._protocol == 5
    assert in_loop(lambda: client(is_old=True))._client._protocol == 4


def test_tls_needs_files_that_are_there():
    assert mqttclient.tls_context(None) is None
    with pytest.raises(FileNotFoundError):
        mqttclient.tls_context(TlsSpec(ca="/nowhere.pem"))
    assert mqttclient.tls_context(TlsSpec()).verify_mode is ssl.CERT_REQUIRED
    assert mqttclient.tls_context(TlsSpec(check_name=False)).verify_mode is ssl.CERT_REQUIRED


@pytest.mark.net
@pytest.mark.parametrize("tls", [None, TlsSpec()])
def test_mqtt_silent_broker_times_out_and_socket_is_closed(tls, monkeypatch):
    monkeypatch.setattr(mqttclient, "CONNECT_S", 0.2)
    monkeypatch.setattr(mqttclient, "ANSWER_S", 0.2)

    async def play():
        made = client(tls=mqttclient.tls_context(tls))
        with pytest.raises(MqttError, match="timed out"):
            async with made:
                pass
        made.close()

    with socket.create_server(("127.0.3.41", 1883)):
        began = time.monotonic()
        asyncio.run(play())
        assert time.monotonic() - began < 2
