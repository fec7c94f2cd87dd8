"""Control methods of gateways."""

from __future__ import annotations

from inspect import isawaitable
from typing import Any

import msgspec
import pytest

from eap.codec.mailbox import MailboxType
from eap.errors import ControlError
from eap.gateway.request_tracker import RequestTracker
from eap.ids import Endpoint, NetId
from eap.runtime.handover import Handover, PortName, SharedSocket, SocketKind
from eap.services.control.bus_methods import GatewayMethods
from eap.services.gateway.gateway import Settings
from eap.services.gateway.gateway_transport import GatewayTable
from eap.services.gateway.reply_encoder import GatewayStatistics
from eap.services.gateway.sessions import SessionKey
from tests.support.cyclic import station
from tests.support.virtualtime import run_virtual

HERE = Endpoint("udp:eap0", "127.0.0.1:9")
FIRST, SECOND = PortName("left", "bus0"), PortName("left", "bus1")
PORT = PortName("left", "eap0")


class Gateway:
    def __init__(self) -> None:
        self.is_open = True
        self.dropped = 0
        self.settings = Settings(NetId.parse("5.1.1.1.3.1"))
        self.tracker = RequestTracker()
        self.statistics = GatewayStatistics()

    def start(self) -> None:
        self.is_open = True

    async def stop(self) -> None:
        self.is_open = False

    def transfers(self) -> list[SessionKey]:
        return [SessionKey(HERE, 1001, MailboxType.FOE)]


@pytest.fixture
def gateways() -> dict[PortName, Gateway]:
    return {FIRST: Gateway(), SECOND: Gateway()}


@pytest.fixture
def ask(gateways):
    handover = Handover(
        supervisor=1, folder="", plant="p", plant_file="",
        stations=(station(name="left"), station(name="right")),
        sockets=(
            SharedSocket(SocketKind.UDP, "127.0.9.1", 34980, owners=(PORT,)),
            SharedSocket(SocketKind.PACKET, "eth0", owners=(PORT,)),
            SharedSocket(SocketKind.AMS_TCP, "127.0.9.1", owners=(PORT,)),
            SharedSocket(SocketKind.GATEWAY_TCP, "127.0.9.1", 34981, owners=(SECOND,)),
        ),
    )  # fmt: skip
    table = GatewayTable()
    table.replace(gateways)
    methods = GatewayMethods(handover, table).table()

    def call(what: str, **params: Any) -> Any:
        answer = methods[f"gateway_{what}"](params)

        async def wait() -> Any:
            return await answer

        found = run_virtual(wait()) if isawaitable(answer) else answer
        return msgspec.to_builtins(found)

    return call


def test_gateway_status_has_clients_and_slaves(ask, gateways) -> None:
    gateways[FIRST].tracker.admit(HERE, b"request", 0)
    gateways[FIRST].statistics.count(1001, MailboxType.COE, [None], 2000)
    first, second = ask("status", station="left")
    assert first["served"] == ["udp://127.0.9.1:34980", "ethernet://eth0"]
    assert second["served"] == ["tcp://127.0.9.1:34981"]
    assert (first["station"], first["port"], first["state"]) == ("left", "bus0", "running")
    assert first["settings"]["answer_ms"] == 900
    assert first["clients"] == [
        {
            "transport": "udp:eap0",
            "address": "127.0.0.1:9",
            "requests": 1,
            "repeated": 0,
            "errors": 0,
            "waiting": 1,
            "transfers": [{"address": 1001, "protocol": "FOE"}],
        }
    ]
    assert first["slaves"][0]["requests"] == 1


def test_one_is_stopped_and_started(ask) -> None:
    assert [row["state"] for row in ask("stop", station="left", port="bus1")] == ["stopped"]
    assert [row["state"] for row in ask("status", station="left")] == ["running", "stopped"]
    assert [row["state"] for row in ask("start", station="left")] == ["running", "running"]


@pytest.mark.parametrize(
    ("params", "reason"),
    [
        ({"station": "lefd"}, "unknown station 'lefd', did you mean left"),
        ({"station": "right"}, "station right has no gateway; it has no bus ports"),
        ({"station": "left", "port": "bus2"}, "no bus port 'bus2'; its bus ports are bus0, bus1"),
    ],
)
def test_unknown_gateway_is_an_error(ask, params, reason) -> None:
    with pytest.raises(ControlError, match=reason):
        ask("stop", **params)
