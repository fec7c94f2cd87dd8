"""The engine's side of the buses in the loop of the test: a master on slaves in memory.

Each request is done at once, so that only what the test wants to happen takes time.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Sequence
from time import monotonic_ns
from typing import Any

import msgspec

from devicebus.mailbox.conversation import Conversation, MailboxMessage, MailboxRequest
from devicebus.master.bus import MasterSettings
from devicebus.master.mailboxes import Unsolicited
from devicebus.master.master import Master, why_closed
from devicebus.master.procedure import Procedure
from devicebus.sim.fault import execute_command
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import DatagramRequest
from eap.engine.bus_requests import bring_all, bring_one
from eap.errors import EapError
from eap.runtime.bus_errors import ErrorRecord, to_record
from eap.runtime.engine_messages import (
    BringSlaves,
    BusChange,
    BusReport,
    Cancel,
    DescribeBus,
    EngineReply,
    EngineRequest,
    EngineStarted,
    ExchangeDatagrams,
    ExchangeMailbox,
    Ping,
    Republish,
    SlaveDescription,
    SlaveReport,
    UnsolicitedMessage,
)
from eap.runtime.handover import PortName
from eap.services.engine_link import EngineLink
from eap.services.slaves.bus_client import BusClient
from tests.support.loopbus import LoopBus

PORT = PortName("left", "bus0")
CYCLE_NS = 2_000_000
LOOK_S = 0.01


class FakeBus:
    """A master and its slaves.

    Attributes:
        is_up: What is said of it.
    """

    def __init__(self, line: LoopBus, target: AlState = AlState.PREOP) -> None:
        self.line = line
        self.is_up = True
        self.master = Master(MasterSettings(frame_timeout_ns=1_000_000))
        self._cycle_ns = 0
        self._asked_ns = monotonic_ns()
        self.finish(self.master.bring_up(line.now_ns, target))

    def finish(self, task: Any) -> Any:
        """Let time go on until a task is done."""
        while not task.is_done:
            self._step()
        return task.result()

    def _step(self) -> None:
        master, now_ns = self.master, self.line.clock()
        if now_ns >= self._cycle_ns:
            self._cycle_ns = now_ns + CYCLE_NS
            master.start_cycle(now_ns)
        for frame in master.frames_to_send(now_ns):
            self.line.segment.receive_frame(bytearray(frame), now_ns, origin=b"")
        self.line.segment.handle_timeout(now_ns)
        for back in self.line.segment.frames_to_send(now_ns):
            master.receive_frame(bytes(back.frame), now_ns)
        master.handle_timeout(now_ns)

    def do(self, request: EngineRequest) -> dict[str, Any]:
        """Return the fields of the answer, or raise."""
        self.catch_up()
        master, now_ns = self.master, self.line.now_ns
        if isinstance(request, DescribeBus):
            return {"report": self.report()}
        if isinstance(request, Republish):
            return {}
        if isinstance(request, ExchangeMailbox):
            talk = _one(request.request)
            return {"message": self.finish(master.converse(request.station, talk, now_ns))}
        if isinstance(request, ExchangeDatagrams):
            replies = self.finish(master.run(_transfer(request.datagrams), now_ns))
            return {"replies": tuple(replies)}
        assert isinstance(request, BringSlaves)
        target = AlState(request.target)
        self.finish(
            bring_one(master, request.station, target, now_ns)
            if request.station
            else bring_all(master, target, now_ns)
        )
        return {}

    def catch_up(self) -> None:
        """Let some of the time pass that has passed outside: who sleeps there waits for slaves."""
        now_ns = monotonic_ns()
        self.line.now_ns += min(now_ns - self._asked_ns, CYCLE_NS)
        self._asked_ns = now_ns
        self._step()

    def report(self) -> BusReport:
        """Say how it is."""
        link = self.master.stats().link
        return BusReport(
            is_up=self.is_up,
            fault="" if self.is_up else "no frame comes back",
            slaves=tuple(_slave(unit) for unit in self.master.slaves.values()),
            frames_sent=link.sent,
            frames_received=link.received,
            timeout_ns=link.timeout_ns,
            round_trip_ns=link.round_trip_ns,
            silent_since_ns=0 if self.master.is_lost else None,
        )

    def change(self, number: int) -> BusChange:
        """Return the message about all of it."""
        report = self.report()
        fields = SlaveDescription.__struct_fields__
        return BusChange(
            bus=number,
            is_up=report.is_up,
            fault=report.fault,
            stations=tuple(each.station for each in report.slaves),
            slaves=tuple(
                SlaveDescription(**{name: getattr(each, name) for name in fields})
                for each in report.slaves
            ),
            is_silent=self.master.is_lost,
        )


def _slave(unit: Any) -> SlaveReport:
    identity, box = unit.found.identity, unit.mailbox
    return SlaveReport(
        station=unit.station,
        name=unit.name,
        vendor=identity.vendor,
        product=identity.product,
        revision=identity.revision,
        serial=identity.serial,
        alias=unit.found.alias,
        state=unit.al_state,
        target=unit.target,
        to_slave=box.sizes.to_slave if box else 0,
        to_master=box.sizes.to_master if box else 0,
        mailbox_fault=None if box else to_record(why_closed(unit)),
        protocols=unit.found.sii.fixed.protocols,
    )


def _one(ask: MailboxRequest) -> Conversation[MailboxMessage]:
    return (yield ask)


def _transfer(accesses: Sequence[DatagramRequest]) -> Procedure[Sequence[Any]]:
    replies, _ = yield accesses
    return replies


class FakeEngine:
    """Answers requests inside the running loop.

    Attributes:
        requests: All that came.
        holds: Requests are not answered while it is set; :meth:`release` does them.
        held_kind: Of those that are held.
    """

    def __init__(self, *buses: FakeBus) -> None:
        self.buses = buses
        self.requests: list[EngineRequest] = []
        self.holds = False
        self.held_kind: type = object
        self._held: list[EngineRequest] = []
        self._published: dict[int, BusChange] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._awaited = 0
        self._enough = asyncio.Event()
        self._sock, self.services = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._sock.setblocking(False)
        asyncio.get_running_loop().add_reader(self._sock, self._receive)

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        asyncio.get_running_loop().remove_reader(self._sock)
        self._sock.close()

    def say_hello(self) -> None:
        """Be a new engine."""
        self._send(EngineStarted(1))
        self._published.clear()

    def publish(self) -> None:
        """Send what has changed on the buses."""
        for number, bus in enumerate(self.buses):
            for event in iter(bus.master.next_event, None):
                if isinstance(event, Unsolicited):
                    self._send(UnsolicitedMessage(number, event))
            change = bus.change(number)
            if change != self._published.get(number):
                self._published[number] = change
                self._send(change)

    def tell(self, message: UnsolicitedMessage) -> None:
        """Pass on what a slave sent unasked."""
        self._send(message)

    def release(self) -> None:
        """Do what was held back, and nothing is any more."""
        self.holds = False
        held, self._held = self._held, []
        for request in held:
            self._take(request)

    async def wait_for(self, count: int) -> None:
        """Wait until so many requests have come."""
        if len(self.requests) < count:
            self._awaited = count
            self._enough.clear()
            await self._enough.wait()

    def of(self, kind: type) -> list[Any]:
        """Return the requests of one kind."""
        return [request for request in self.requests if isinstance(request, kind)]

    def _receive(self) -> None:
        octets = self._sock.recv(1 << 20)
        request: EngineRequest = msgspec.msgpack.decode(octets, type=EngineRequest)
        self.requests.append(request)
        if len(self.requests) == self._awaited:
            self._enough.set()
        if self.holds and isinstance(request, self.held_kind):
            self._held.append(request)
        else:
            self._take(request)

    def _take(self, request: EngineRequest) -> None:
        if isinstance(request, Cancel):
            return
        fields: dict[str, Any] = {}
        try:
            fields = {} if isinstance(request, Ping) else self.buses[request.bus].do(request)
        except EapError as exc:
            fields = {"error": to_record(exc)}
        except IndexError:
            fields = {"error": ErrorRecord("BusError", "no such bus")}
        if isinstance(request, Republish):
            self._published.pop(request.bus, None)
            self._timer = self._timer or asyncio.get_running_loop().call_later(LOOK_S, self._look)
        self.publish()
        self._send(EngineReply(id=request.id, **fields))

    def _look(self) -> None:
        """Let time go on and send what has changed, as an engine does between its cycles."""
        if not self.holds:
            for bus in self.buses:
                bus.catch_up()
            self.publish()
        self._timer = asyncio.get_running_loop().call_later(LOOK_S, self._look)

    def _send(self, message: Any) -> None:
        self._sock.send(msgspec.msgpack.encode(message))


class FakeSegment:
    """Takes commands for slaves in memory, inside the running loop.

    Attributes:
        is_silent: Nothing is answered.
    """

    def __init__(self, line: LoopBus) -> None:
        self.is_silent = False
        self._line = line
        self._sock, self.services = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        asyncio.get_running_loop().add_reader(self._sock, self._receive)

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._sock)
        self._sock.close()

    def say(self, message: Any) -> None:
        """Send anything."""
        self._sock.send(msgspec.json.encode(message))

    def _receive(self) -> None:
        command = msgspec.json.decode(self._sock.recv(1 << 16))
        if self.is_silent:
            return
        answer = {"id": command.pop("id"), "ok": True}
        try:
            execute_command(self._line.segment, command, self._line.now_ns)
        except ValueError as exc:
            answer |= {"ok": False, "error": str(exc)}
        self.say(answer)


def bus_clients(link: EngineLink, *ports: PortName) -> dict[PortName, BusClient]:
    """Return clients of the buses of a fake engine, in their order."""
    return {port: BusClient(link, number, port) for number, port in enumerate(ports)}
