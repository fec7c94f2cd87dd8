"""The control server with real clients over socket pairs."""

from __future__ import annotations

import asyncio
import json
import os
import socket

import pytest

from eap.ams.spec import Role
from eap.config.users import PlantUserSection
from eap.control.protocol import MAX_LINE, MAX_SUBSCRIPTIONS
from eap.errors import ControlError, TornReadError
from eap.ids import InterfaceUri, NetId
from eap.net.limits import Activity, CloseReason, ListenerLimits
from eap.od.abort import AbortCode, SdoAbortError
from eap.pd.spec import PortKind, PortSpec, StationSpec
from eap.runtime.logins import Principal
from eap.services.control import control_server
from eap.services.control.bus_methods import Buses
from eap.services.control.control_server import (
    ControlConnection,
    ControlPeer,
    ControlServer,
    PeerRoles,
)
from eap.services.control.methods import Methods, Watch
from eap.services.engine_link import EngineLink
from eap.services.transports.accepting import Listeners
from tests.support.eventually import eventually, settle
from tests.support.fakeengine import PORT, FakeBus, FakeEngine, bus_clients
from tests.support.loopbus import LoopBus

pytestmark = pytest.mark.net


async def torn():
    raise TornReadError("torn", writer="engine")


@pytest.fixture
def methods(images):
    return Methods({"plant": "demo"}, images, status=torn, stop=lambda: 1 / 0)


NO_BUSES = Buses({}, {}, {})


def serve_client(server: ControlServer, sock: socket.socket):
    return server.serve_connection(ControlConnection(""), sock)


class Talk:
    """One client of a server, both in one loop."""

    def __init__(self, server: ControlServer) -> None:
        self._server = server

    async def __aenter__(self):
        ours, theirs = socket.socketpair()
        self.task = asyncio.ensure_future(serve_client(self._server, theirs))
        self.reader, self.writer = await asyncio.open_unix_connection(sock=ours, limit=2 * MAX_LINE)
        return self

    async def __aexit__(self, *_):
        self.writer.close()
        await asyncio.wait_for(self.task, 5)

    def say(self, line: str | bytes) -> None:
        self.writer.write((line.encode() if isinstance(line, str) else line) + b"\n")

    async def hear(self) -> dict:
        return json.loads(await asyncio.wait_for(self.reader.readline(), 5))

    async def ask(self, method: str, **params) -> dict:
        self.say(json.dumps({"v": 1, "id": 1, "method": method, "params": params}))
        return await self.hear()


def test_requests_are_answered_in_order(methods):
    async def conversation():
        async with Talk(ControlServer(methods, NO_BUSES)) as client:
            for number in range(3):
                client.say(f'{{"v":1,"id":{number},"method":"hello"}}')
            assert [(await client.hear())["id"] for _ in range(3)] == [0, 1, 2]

    asyncio.run(conversation())


def test_refusals_keep_the_connection(methods):
    async def conversation():
        async with Talk(ControlServer(methods, NO_BUSES)) as client:
            client.say("what?")
            assert (await client.hear())["error"]["code"] == "bad_request"
            client.say('{"v":2,"id":7,"method":"hello"}')
            answer = await client.hear()
            assert (answer["id"], answer["error"]["code"]) == (7, "version")
            assert (await client.ask("helo"))["error"]["code"] == "unknown_method"
            assert (await client.ask("status"))["error"]["code"] == "unavailable"
            assert (await client.ask("stop"))["error"]["code"] == "internal"
            assert (await client.ask("hello"))["result"]["plant"] == "demo"

    asyncio.run(conversation())


def test_changes_are_audited_before_the_answer(images):
    def refuse(params):
        raise SdoAbortError(AbortCode.NO_OBJECT, 0x2000, 1)

    more = {"od_write": refuse, "request_state": lambda params: {"error": None}}
    methods = Methods({}, images, status=torn, stop=lambda: None, more=more)
    told = []

    async def conversation():
        server = ControlServer(methods, NO_BUSES, lambda *line: told.append(line))
        async with Talk(server) as client:
            await client.ask("hello")
            await client.ask("od_write", target="left")
            (first,) = told
            await client.ask("request_state", target="left", state="OP")
            return first, told[1]

    first, second = asyncio.run(conversation())
    assert first[:2] == second[:2] == (f"uid {os.getuid()}, pid {os.getpid()}", "left")
    assert "object does not exist" in first[2]["error"]
    assert second[2] == {
        "operation": "request_state", "asked": {"target": "left", "state": "OP"}, "error": "",
    }  # fmt: skip


def test_change_that_cannot_be_recorded_is_refused(images):
    done, told = [], []
    methods = Methods(
        {}, images, status=torn, stop=lambda: None, more={"od_write": lambda params: done.append(1)}
    )

    async def conversation():
        server = ControlServer(
            methods,
            NO_BUSES,
            lambda *line: told.append(line),
            announce=lambda *_: "the disk is full",
        )
        async with Talk(server) as client:
            await client.ask("hello")
            return await client.ask("od_write", target="left")

    error = asyncio.run(conversation())["error"]
    assert (error["code"], error["message"]) == ("refused", "the disk is full")
    assert not done
    assert not told  # what refuses it writes that down


def test_errors_of_dictionaries_have_their_abort_code(images):
    def refuse(params):
        raise SdoAbortError(AbortCode.NO_OBJECT, 0x2000, 1)

    methods = Methods({}, images, status=torn, stop=lambda: None, more={"od_read": refuse})

    async def conversation():
        async with Talk(ControlServer(methods, NO_BUSES)) as client:
            error = (await client.ask("od_read"))["error"]
            assert (error["code"], error["detail"]) == ("abort", 0x06020000)
            assert error["message"].startswith("0x2000:01: object does not exist")

    asyncio.run(conversation())


def test_a_line_without_end_is_refused_and_ends_the_connection(methods):
    async def conversation():
        async with Talk(ControlServer(methods, NO_BUSES)) as client:
            client.say(b"x" * (MAX_LINE + 1))
            assert str(MAX_LINE) in (await client.hear())["error"]["message"]
            assert await client.reader.read() == b""

    asyncio.run(conversation())


def test_subscriptions_run_beside_requests_until_unsubscribed(methods):
    async def conversation():
        async with Talk(ControlServer(methods, NO_BUSES)) as client:
            answer = await client.ask("subscribe", station="left", names=["name"], period_ms=10)
            number = answer["result"]["subscription"]
            event = await client.hear()
            assert event["subscription"] == number
            assert event["event"]["values"] == {"name": "abc"}
            assert (await client.hear())["subscription"] == number
            client.say('{"v":1,"id":5,"method":"hello"}')
            while "result" not in (answer := await client.hear()):
                assert answer["subscription"] == number
            assert answer["id"] == 5
            params = json.dumps({"subscription": number})
            client.say(f'{{"v":1,"id":6,"method":"unsubscribe","params":{params}}}')
            while "result" not in (answer := await client.hear()):
                pass
            assert answer["result"] == {"unsubscribed": number}
            again = await client.ask("unsubscribe", subscription=number)
            assert again["error"]["code"] == "unknown_name"

    asyncio.run(conversation())


@pytest.mark.parametrize(
    ("exc", "code"),
    [
        (TornReadError("torn", writer="engine"), "unavailable"),
        (ControlError("gone", code="unknown_name"), "unknown_name"),
    ],
)
def test_subscription_survives_unreadable_values(methods, monkeypatch, exc, code):
    def fail(self):
        raise exc

    async def conversation():
        async with Talk(ControlServer(methods, NO_BUSES)) as client:
            with monkeypatch.context() as patch:
                patch.setattr(Watch, "next_event", fail)
                await client.ask("subscribe", station="left", names=["name"], period_ms=10)
                assert (await client.hear())["event"]["error"]["code"] == code
            while "error" in (event := (await client.hear())["event"]):
                pass
            assert event["values"] == {"name": "abc"}

    asyncio.run(conversation())


def test_there_are_limits_on_subscriptions(methods):
    async def conversation():
        async with Talk(ControlServer(methods, NO_BUSES)) as client:
            for _ in range(MAX_SUBSCRIPTIONS):
                answer = await client.ask("subscribe", station="left", on="change", names=["name"])
                assert "result" in answer
                await client.hear()
            answer = await client.ask("subscribe", station="left")
            assert answer["error"]["code"] == "busy"

    asyncio.run(conversation())


def test_listener_is_full_of_subscribers_and_has_room_when_one_leaves(
    methods, monkeypatch, tmp_path
):
    monkeypatch.setattr(control_server, "LIMITS", ListenerLimits(total=2, reserved=0, per_host=3))
    listeners = Listeners()

    async def ask(reader, writer, method):
        line = {"v": 1, "id": 1, "method": method, "params": {"station": "left", "on": "change"}}
        if method == "hello":
            del line["params"]
        writer.write(json.dumps(line).encode() + b"\n")
        return json.loads(await reader.readline())

    async def conversation():
        with socket.socket(socket.AF_UNIX) as listener:
            path = str(tmp_path / "control")
            listener.bind(path)
            listener.listen()
            server = ControlServer(methods, NO_BUSES)
            serving = asyncio.ensure_future(server.serve(listener, listeners))
            clients = []
            for _ in range(2):
                clients.append(await asyncio.open_unix_connection(path))
                assert "result" in await ask(*clients[-1], "subscribe")
            clients.append(await asyncio.open_unix_connection(path))
            refusal = json.loads(await clients[-1][0].readline())["error"]
            assert (refusal["code"], refusal["message"]) == ("busy", "all 2 places are taken")
            clients[0][1].close()
            await eventually(lambda: listeners.stats()[0].open == 1)
            clients.append(await asyncio.open_unix_connection(path))
            assert "result" in await ask(*clients[-1], "hello")
            for _, writer in clients:
                writer.close()
            serving.cancel()
            await asyncio.wait([serving])

    asyncio.run(conversation())


def test_line_that_stays_unfinished_makes_its_client_late(methods):
    async def conversation():
        ours, theirs = socket.socketpair()
        connection = ControlConnection("")
        server = ControlServer(methods, NO_BUSES)
        serving = asyncio.ensure_future(server.serve_connection(connection, theirs))
        with ours:
            ours.sendall(b'{"v":1,')
            await eventually(lambda: connection.late_since_ns is not None)
            assert connection.activity is Activity.UNUSED
            ours.sendall(b'"id":1,"method":"hello"}\n')
            await eventually(lambda: connection.late_since_ns is None)
            assert connection.activity in {Activity.IDLE, Activity.BUSY}
            connection.close(CloseReason.OVERDUE)
            await asyncio.wait([serving])

    asyncio.run(conversation())


def test_client_that_does_not_read_is_disconnected(methods):
    async def conversation():
        server = ControlServer(methods, NO_BUSES, slow_reader_s=0.05)
        ours, theirs = socket.socketpair()
        with ours:
            ours.sendall(b'{"v":1,"method":"variables","params":{"station":"left"}}\n' * 2000)
            await asyncio.wait_for(serve_client(server, theirs), 10)

    asyncio.run(conversation())


def test_a_listener_serves_many(methods, tmp_path):
    async def conversation():
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(tmp_path / "control"))
            listener.listen()
            serving = asyncio.ensure_future(
                ControlServer(methods, NO_BUSES).serve(listener, Listeners())
            )
            for _ in range(2):
                reader, writer = await asyncio.open_unix_connection(str(tmp_path / "control"))
                writer.write(b'{"v":1,"id":1,"method":"hello"}\n')
                assert json.loads(await reader.readline())["id"] == 1
                writer.close()
                await writer.wait_closed()
            serving.cancel()
            await asyncio.wait([serving])

    asyncio.run(conversation())


class Slow:
    """Methods that wait, and what became of those who waited."""

    def __init__(self) -> None:
        self.outcomes = []
        self.begun = asyncio.Event()
        self.go_on = asyncio.Event()

    async def wait(self):
        self.begun.set()
        try:
            await self.go_on.wait()
        except asyncio.CancelledError:
            self.outcomes.append("cancelled")
            raise
        self.outcomes.append("answered")
        return {}


STATUS = b'{"v":1,"id":1,"method":"status"}\n'


@pytest.mark.parametrize("rest", [b"", STATUS * 3, b'{"v":1'])
def test_request_of_a_disconnected_client_is_cancelled(files, rest):
    async def conversation():
        slow = Slow()
        methods = Methods({}, files, status=slow.wait, stop=lambda: None)
        server = ControlServer(methods, NO_BUSES)
        ours, theirs = socket.socketpair()
        with ours:
            serving = asyncio.ensure_future(serve_client(server, theirs))
            ours.sendall(STATUS + rest)
            await slow.begun.wait()
        await asyncio.wait_for(serving, 10)
        assert slow.outcomes == ["cancelled"]

    asyncio.run(conversation())


def test_half_closed_client_gets_answers(files):
    async def conversation():
        slow = Slow()
        methods = Methods({}, files, status=slow.wait, stop=lambda: None)
        ours, theirs = socket.socketpair()
        with ours:
            ours.sendall(STATUS)
            ours.shutdown(socket.SHUT_WR)
            serving = asyncio.ensure_future(serve_client(ControlServer(methods, NO_BUSES), theirs))
            await slow.begun.wait()
            await settle()
            slow.go_on.set()
            await asyncio.wait_for(serving, 10)
            assert ours.recv(100) == b'{"v":1,"id":1,"result":{}}\n'
        assert slow.outcomes == ["answered"]

    asyncio.run(conversation())


def test_requests_before_a_disconnect_are_executed(files):
    async def conversation():
        stopped = []
        methods = Methods({}, files, status=torn, stop=lambda: stopped.append(True))
        ours, theirs = socket.socketpair()
        with ours:
            ours.sendall(b'{"v":1,"id":1,"method":"stop"}\n')
        await asyncio.wait_for(serve_client(ControlServer(methods, NO_BUSES), theirs), 5)
        assert stopped == [True]

    asyncio.run(conversation())


def test_subscriber_that_has_left_already_is_no_defect(methods, caplog):
    async def conversation():
        ours, theirs = socket.socketpair()
        params = b'{"station":"left","names":["name"],"period_ms":10}'
        line = b'{"v":1,"id":1,"method":"subscribe","params":%s}\n' % params
        with ours:
            ours.sendall(line * 6)
        await asyncio.wait_for(serve_client(ControlServer(methods, NO_BUSES), theirs), 5)

    asyncio.run(conversation())
    assert caplog.messages == []


def test_errors_of_a_bus_keep_kind_and_detail(methods):
    async def conversation():
        engine = FakeEngine(FakeBus(LoopBus("drive")))
        link = EngineLink(engine.services)
        port = PortSpec(
            "bus0", PortKind.BUS, InterfaceUri.parse("sim://x.yaml"), NetId.parse("1.1.1.1.3.1")
        )
        station = StationSpec("left", NetId.parse("1.1.1.1.1.1"), 10_000, (port,))
        buses = Buses({"left": station}, bus_clients(link, PORT), {})
        where = {"station": "left", "port": "bus0"}
        async with Talk(ControlServer(methods, buses)) as client:
            answer = await client.ask("bus_open", **where, slave=1009, protocol="coe")
            assert answer["result"] == {"conversation": 1}
            answer = await client.ask("bus_ask", conversation=1, request="00")
            assert answer["error"]["code"] == "bus"
            assert answer["error"]["kind"] == "BusError"
            assert "unknown slave 1009" in answer["error"]["message"]
            engine.buses[0].line.fault(kind="refuse", slave="drive", state="SAFEOP", code=0x1B)
            error = (await client.ask("bus_bring", **where, state="SAFEOP"))["error"]
            assert (error["kind"], error["detail"]) == ("AlStatusError", 2 << 16 | 0x1B)
        link.close()
        engine.close()

    asyncio.run(conversation())


def test_role_of_a_client_limits_it_and_its_name_is_audited(methods, monkeypatch):
    lines = []

    def record(peer, station, fields):
        lines.append((station, fields["operation"], fields.get("user"), fields["error"]))

    anna = PlantUserSection(name="anna", role=Role.OPERATOR, unix=("anna",))
    roles = PeerRoles([anna], ["*/setpoint"])
    server = ControlServer(methods, NO_BUSES, record, roles=roles)
    peers = [ControlPeer("uid 7, pid 9", Principal("anna", Role.OPERATOR)), None]
    monkeypatch.setattr(PeerRoles, "own_peer", lambda *_: None)
    monkeypatch.setattr(PeerRoles, "identify", lambda *_: peers.pop(0))

    async def conversation():
        async with Talk(server) as talk:
            assert "result" in await talk.ask("hello")
            refused = (await talk.ask("stop"))["error"]
            assert refused == {
                "code": "refused",
                "message": "anna is operator, and stop needs engineer",
            }
            assert "result" in await talk.ask("hello")
        async with Talk(server) as talk:
            assert "has no role" in (await talk.ask("status"))["error"]["message"]

    asyncio.run(conversation())
    assert lines == [
        ("", "stop", "anna", "anna is operator, and stop needs engineer"),
        ("", "connect", None, f"user {os.getuid()} of this host has no role in the plant file"),
    ]
