"""Methods on buses, as one connection after the other asks for them."""

from __future__ import annotations

import asyncio

import msgspec
import pytest

from devicebus.errors import BusError, MailboxTimeoutError
from eap.control import bus as control_bus
from eap.control.bus import BUS_METHODS
from eap.control.protocol import ErrorCode
from eap.errors import ControlError, EngineGoneError
from eap.ids import InterfaceUri, NetId
from eap.pd.spec import PortKind, PortSpec, StationSpec
from eap.runtime.engine_messages import Cancel, ExchangeMailbox
from eap.runtime.handover import PortName
from eap.services.control.bus_methods import BusConnection, Buses, bus_reports
from eap.services.engine_link import EngineLink
from eap.services.slaves.segment_link import SegmentLink
from tests.support.fakeengine import PORT, FakeBus, FakeEngine, FakeSegment, bus_clients
from tests.support.loopbus import LoopBus
from tests.support.virtualtime import run_virtual

WHERE = {"station": "left", "port": "bus0"}
VENDOR = "00204018100100000000"
STATIONS = (
    StationSpec(
        "left",
        NetId.parse("1.1.1.1.1.1"),
        10_000,
        (
            PortSpec(
                "eap0",
                PortKind.EAP,
                InterfaceUri.parse("udp://127.9.2.1"),
                NetId.parse("1.1.1.1.2.1"),
            ),
            PortSpec(
                "bus0", PortKind.BUS, InterfaceUri.parse("sim://x.yaml"), NetId.parse("1.1.1.1.3.1")
            ),
            PortSpec(
                "bus1",
                PortKind.BUS,
                InterfaceUri.parse("udp://127.9.2.9"),
                NetId.parse("1.1.1.1.4.1"),
            ),
        ),
    ),
    StationSpec("right", NetId.parse("1.1.1.1.1.2"), 10_000, ()),
)


class Connection(BusConnection):
    """A connection whose results are as JSON has them."""

    async def call(self, method, params):
        return msgspec.to_builtins(await super().call(method, params))


class Scene:
    """The buses of an appliance, and the engine behind them."""

    def __init__(self) -> None:
        line = LoopBus("drive")
        self.engine = FakeEngine(FakeBus(line))
        self.segment = FakeSegment(line)
        self._link = EngineLink(self.engine.services, silence_limit_s=0.1)
        self._segment_link = SegmentLink(self.segment.services)
        self.clients = bus_clients(self._link, PORT, PortName("left", "bus1"))
        stations = {each.name: each for each in STATIONS}
        self.buses = Buses(stations, self.clients, {PORT: self._segment_link})

    def connect(self):
        return Connection(self.buses)

    def close(self):
        for each in (self._link, self._segment_link, self.engine, self.segment):
            each.close()


def play(scene):
    async def run():
        stage = Scene()
        try:
            async with asyncio.timeout(20):
                await scene(stage, stage.connect())
        finally:
            stage.close()

    run_virtual(run())


async def refusal(connection, method, **params):
    with pytest.raises(ControlError) as caught:
        await connection.call(method, params)
    return caught.value


async def open_coe(connection):
    answer = await connection.call("bus_open", WHERE | {"slave": 1001, "protocol": "coe"})
    return answer["conversation"]


def ask(connection, number, **more):
    params = {"conversation": number, "request": VENDOR, **more}
    return connection.call("bus_ask", params)


def test_bus_describe_reports_the_bus():
    async def scene(stage, connection):
        for more in ({}, {"wait": True}):
            report = await connection.call("bus_describe", WHERE | more)
            assert report["is_up"]
            assert report["slaves"][0]["name"] == "drive"

    play(scene)


def test_bus_ask_converses_with_a_slave():
    async def scene(stage, connection):
        number = await open_coe(connection)
        answer = await ask(connection, number)
        assert answer["data"].endswith("5a0e0000")
        with pytest.raises(MailboxTimeoutError):
            await ask(connection, number, listen=True, timeout_ms=5)
        assert await connection.call("bus_close", {"conversation": number}) == {"closed": number}
        error = await refusal(connection, "bus_ask", conversation=number, request="")
        assert error.code == ErrorCode.UNKNOWN_NAME
        assert await open_coe(connection) == number + 1

    play(scene)


def test_one_after_the_other():
    async def scene(stage, connection):
        other = stage.connect()
        number = await open_coe(connection)
        waiting = asyncio.ensure_future(open_coe(other))
        await ask(connection, number)
        assert not waiting.done()
        await connection.call("bus_close", {"conversation": number})
        assert (await ask(other, await waiting))["data"]

    play(scene)


def test_closed_connection_releases_its_mailbox():
    async def scene(stage, connection):
        number = await open_coe(connection)
        stage.engine.holds = True
        asking = asyncio.ensure_future(ask(connection, number))
        await stage.engine.wait_for(2)
        asking.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asking
        connection.close()
        await stage.engine.wait_for(4)
        assert [type(each) for each in stage.engine.requests[-2:]] == [Cancel, ExchangeMailbox]
        assert not stage.engine.requests[-1].request.expects_reply
        stage.engine.release()
        other = stage.connect()
        assert (await ask(other, await open_coe(other)))["data"]

    play(scene)


def test_idle_conversation_is_ended(monkeypatch):
    monkeypatch.setattr(control_bus, "IDLE_S", 0.05)

    async def scene(stage, connection):
        number = await open_coe(connection)
        await ask(connection, number, delay_ms=0)
        other = stage.connect()
        assert (await ask(other, await open_coe(other)))["data"]
        error = await refusal(connection, "bus_ask", conversation=number, request="")
        assert "is ended" in str(error)

    play(scene)


def test_turn_that_does_not_come(monkeypatch):
    monkeypatch.setattr(control_bus, "TURN_S", 0.05)

    async def scene(stage, connection):
        number = await open_coe(connection)
        params = WHERE | {"slave": 1001, "protocol": "coe"}
        error = await refusal(stage.connect(), "bus_open", **params)
        assert (error.code, "COE mailbox was busy" in str(error)) == (ErrorCode.BUSY, True)
        await ask(connection, number)

    play(scene)


def test_limit_of_conversations(monkeypatch):
    monkeypatch.setattr(control_bus, "MAX_CONVERSATIONS", 1)

    async def scene(stage, connection):
        await open_coe(connection)
        error = await refusal(connection, "bus_open", **WHERE, slave=1001, protocol="foe")
        assert error.code == ErrorCode.BUSY

    play(scene)


def test_datagrams_and_states():
    async def scene(stage, connection):
        rows = [[4, 1001, 0x10, "0000", 3], [4, 1005, 0x10, "0000", 1]]
        answer = await connection.call("bus_transfer", WHERE | {"datagrams": rows})
        assert answer["replies"] == [(1, "e903", 1), (0, "0000", 1)]
        answer = await connection.call("bus_bring", WHERE | {"state": "INIT"})
        assert answer == {"state": "INIT"}
        assert (await connection.call("bus_describe", WHERE))["slaves"][0]["state"] == 1
        with pytest.raises(BusError, match="unknown slave 1009"):
            await connection.call("bus_bring", WHERE | {"slave": 1009, "state": "INIT"})

    play(scene)


def test_bus_fault_reaches_the_segment():
    async def scene(stage, connection):
        command = {"kind": "power", "slave": "drive"}
        assert await connection.call("bus_fault", WHERE | {"command": command}) == {"ok": True}
        for wrong in ({"kind": "power"}, {"kind": "powr"}, {"kind": []}):
            error = await refusal(connection, "bus_fault", **WHERE, command=wrong)
            assert error.code == ErrorCode.VALUE
        error = await refusal(connection, "bus_fault", station="left", port="bus1", command=command)
        assert (error.code, "is not simulated" in str(error)) == (ErrorCode.REFUSED, True)

    play(scene)


@pytest.mark.parametrize(
    ("station", "port", "reason"),
    [
        ("lefd", "bus0", "unknown station 'lefd', did you mean left?"),
        ("left", "eap0", "port eap0 of station left is no bus; its bus ports are bus0, bus1"),
        ("left", "bus2", "no port 'bus2'; its bus ports are bus0, bus1, did you mean bus"),
        ("right", "bus0", "station right has no port 'bus0'; it has no bus ports"),
    ],
)
def test_bus_that_is_none(station, port, reason):
    async def scene(stage, connection):
        error = await refusal(connection, "bus_describe", station=station, port=port)
        assert error.code == ErrorCode.UNKNOWN_NAME
        assert reason in str(error)

    play(scene)


def test_parameters_are_checked():
    async def scene(stage, connection):
        for method in BUS_METHODS:
            assert (await refusal(connection, method, x=1)).code == ErrorCode.BAD_REQUEST
        number = await open_coe(connection)
        error = await refusal(connection, "bus_ask", conversation=number, request="xy")
        assert "hexadecimal" in str(error)
        error = await refusal(connection, "bus_transfer", **WHERE, datagrams=[])
        assert error.code == ErrorCode.BAD_REQUEST

    play(scene)


def test_reports_of_those_that_answer():
    async def scene(stage, connection):
        assert set(await bus_reports(stage.clients, 1)) == {PORT}  # the engine knows one bus only
        stage.engine.holds = True
        assert await bus_reports(stage.clients, 0.01) == {}
        with pytest.raises(EngineGoneError):
            await connection.call("bus_describe", WHERE)

    play(scene)


def test_appliance_without_buses():
    async def scene():
        buses = Buses({"right": STATIONS[1]}, {}, {})
        assert await bus_reports({}, 1) == {}
        error = await refusal(Connection(buses), "bus_describe", station="right", port="bus0")
        assert "has no bus ports" in str(error)

    run_virtual(scene())
