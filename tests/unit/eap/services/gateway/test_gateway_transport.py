"""Frames that are no AoE to a station."""

from __future__ import annotations

from typing import Any

from eap.codec.mailbox import decode_frame
from eap.ids import Endpoint, NetId
from eap.runtime.drop_counters import DropReason
from eap.runtime.handover import PortName
from eap.services.gateway.gateway import Settings
from eap.services.gateway.gateway_transport import GatewayTable, GatewayTransport
from tests.support.virtualtime import run_virtual

UPLOAD = bytes.fromhex("10 50 0a 00 e9 03 00 23 00 20 41 18 10 02 00 00 00 00")


class Gateway:
    def __init__(self) -> None:
        self.is_open = True
        self.settings = Settings(NetId.parse("10.0.0.1.3.1"))
        self.dropped = 0
        self.heard: list[Any] = []

    def receive(self, frame, endpoint, send) -> None:
        header, body = decode_frame(frame)
        self.heard.append((header.address, bytes(body), endpoint))
        send(b"answer")

    def connection_closed(self, endpoint) -> None:
        self.heard.append(("closed", endpoint))

    async def wait_below(self, endpoint, count) -> None:
        self.heard.append(("below", endpoint, count))


def behind(*gateways: Gateway) -> GatewayTransport:
    """Return the transport with the gateways of stations a, b, ... behind it."""
    table = GatewayTable()
    stations = "ab"[: len(gateways)]
    table.replace(
        {PortName(name, "bus0"): each for name, each in zip(stations, gateways, strict=True)}
    )
    return GatewayTransport(table, {name: f"udp:{name}" for name in "ab"})


def test_the_first_station_with_a_bus_has_the_gateway() -> None:
    first, second = Gateway(), Gateway()
    transport = behind(first, second)
    sent = []
    assert transport.receive(UPLOAD, "me", lambda *each: sent.append(each)) is None
    assert first.heard == [(1001, UPLOAD[8:], Endpoint("udp:a", "me"))]
    assert not second.heard
    assert sent == [("me", b"answer")]
    transport.connection_closed("me")
    run_virtual(transport.wait_below("me", 3))
    assert first.heard[1:] == [
        ("closed", Endpoint("udp:a", "me")),
        ("below", Endpoint("udp:a", "me"), 3),
    ]


def test_transport_without_a_gateway_drops_frames() -> None:
    transport = behind()
    assert transport.receive(UPLOAD, "me", lambda *each: None) is DropReason.MAILBOX
    transport.connection_closed("me")
    run_virtual(transport.wait_below("me", 1))


def test_unknown_protocol_is_answered_with_a_mailbox_error() -> None:
    transport = behind(Gateway())
    sent = []
    frame = UPLOAD[:7] + bytes((0x17,)) + UPLOAD[8:]
    assert transport.receive(frame, "me", lambda *each: sent.append(each)) is DropReason.MAILBOX
    assert sent == [("me", bytes.fromhex("0a50 0400 e903 00 00 0100 0200"))]


def test_a_silent_gateway_does_not_refuse_a_protocol_either() -> None:
    gateway = Gateway()
    gateway.settings = gateway.settings._replace(is_silent=True)
    frame = UPLOAD[:7] + bytes((0x17,)) + UPLOAD[8:]
    sent = []
    transport = behind(gateway)
    assert transport.receive(frame, "me", lambda *each: sent.append(each)) is DropReason.MAILBOX
    assert not sent


def test_a_gateway_that_is_stopped_turns_frames_away() -> None:
    gateway = Gateway()
    gateway.is_open = False
    transport = behind(gateway)
    assert transport.receive(UPLOAD, "me", lambda *each: None) is DropReason.GATEWAY_OFF
    assert gateway.dropped == 1
    assert not gateway.heard


def test_a_frame_that_is_cut_is_counted() -> None:
    transport = behind(Gateway())
    assert transport.receive(UPLOAD[:-2], "me", lambda *each: None) is DropReason.TRUNCATED


def test_gateways_behind_a_socket_come_and_go() -> None:
    first, second = Gateway(), Gateway()
    table = GatewayTable()
    shared = GatewayTransport(table, {"a": "udp:a"})
    own = GatewayTransport(table, {"a": "udp:a"}, PortName("a", "bus1"))
    assert not shared.has_gateway
    table.replace({PortName("a", "bus0"): first, PortName("a", "bus1"): second})
    assert shared.receive(UPLOAD, "me", lambda *each: None) is None
    assert own.receive(UPLOAD, "me", lambda *each: None) is None
    assert (len(first.heard), len(second.heard)) == (1, 1)
    table.replace({PortName("a", "bus1"): second})
    assert shared.receive(UPLOAD, "me", lambda *each: None) is None
    assert (len(first.heard), len(second.heard)) == (1, 2)
    table.replace({})
    assert own.receive(UPLOAD, "me", lambda *each: None) is DropReason.MAILBOX
    assert own.waiting("me") == 0
