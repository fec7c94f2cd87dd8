"""Requests of services to the engine, and their replies.

Neither side waits for the other: a request beyond the limits fails at once, and a reply that
services does not read is dropped.
"""

from __future__ import annotations

import os
import socket
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias, TypeVar

import msgspec
from msgspec.structs import replace

from devicebus.errors import BusError
from devicebus.mailbox.conversation import Conversation, MailboxMessage, MailboxRequest
from devicebus.master.bus import BusSlave
from devicebus.master.findings import join_errors
from devicebus.master.link import MAX_DATA
from devicebus.master.mailboxes import Unsolicited
from devicebus.master.master import Master
from devicebus.master.procedure import Procedure, Task
from devicebus.wire.alstatus import WITH_PROCESS_DATA, AlState
from devicebus.wire.datagram import AS_SET, Command, DatagramReply, DatagramRequest
from eap.engine.bus_report import BusPublisher, report_bus
from eap.engine.engine_bus import EngineBus
from eap.errors import EapError, EngineRefusedError
from eap.runtime.bus_errors import to_record
from eap.runtime.engine_messages import (
    BringSlaves,
    BusChange,
    BusReport,
    BusRequest,
    Cancel,
    Configure,
    DescribeBus,
    EngineMessage,
    EngineReply,
    EngineRequest,
    EngineStarted,
    ExchangeDatagrams,
    ExchangeMailbox,
    ForgetFaults,
    Ping,
    Republish,
    SetState,
    StationRequest,
    UnsolicitedMessage,
)

T = TypeVar("T")

PER_WAKE_UP = 16
MAX_OUTSTANDING = 1024
MAX_PER_SLAVE = 64
_MAX_MESSAGE = 1 << 18
_SlaveKey = tuple[int, int]
ServeStation: TypeAlias = Callable[[StationRequest, int, Callable[[EapError | None], None]], None]
MAX_DATAGRAMS = 256
"""Datagrams of one request."""
MAX_TRIES = 8
_ALLOWED = frozenset(
    (
        *(Command.NOP, Command.APRD, Command.APWR, Command.APRW, Command.FPRD),
        *(Command.FPWR, Command.FPRW, Command.BRD),
    )
)
"""Commands that do not disturb the process data: none logical, no broadcast write."""


class _Numbered(msgspec.Struct):
    """Number of a request that cannot be understood otherwise."""

    id: int


class _PendingRequest(NamedTuple):
    """A request that is under way."""

    task: Task[Any]
    slave_key: _SlaveKey
    """Bus and station, 0 for a bus as a whole."""


class BusRequestHandler:
    """Takes requests from *sock* and answers them.

    Args:
        sock: The engine's end of the pair with services.
        serve_station: Serves requests to a station, and calls back when one is done.

    Attributes:
        malformed: Messages that were no requests.
        dropped: Replies that services did not take.
    """

    def __init__(self, sock: socket.socket, serve_station: ServeStation) -> None:
        self.malformed = 0
        self.dropped = 0
        self._sock = sock
        self._buses: dict[int, tuple[EngineBus, BusPublisher]] = {}
        """By number."""
        self._serve_station = serve_station
        self._decoder = msgspec.msgpack.Decoder(EngineRequest)
        self._pending: dict[int, _PendingRequest] = {}
        self._per_slave: Counter[_SlaveKey] = Counter()
        sock.setblocking(False)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when there is a request."""
        return self._sock.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()

    def add(self, number: int, bus: EngineBus) -> None:
        """Serve requests to *bus* under its *number* from now on."""
        self._buses[number] = bus, BusPublisher(number, bus, self._send)
        bus.faults.on_unsolicited.append(partial(self._forward, number))

    def remove(self, number: int) -> None:
        """Refuse requests to the bus numbered *number* from now on; those under way are its own."""
        del self._buses[number]

    def announce(self) -> None:
        """Send the first message of a new engine."""
        self._send(EngineStarted(os.getpid()))

    def publish(self) -> None:
        """Send the changes on the buses."""
        for _, publisher in self._buses.values():
            publisher.flush()

    def serve(self, now_ns: int) -> None:
        """Serve a few of the waiting requests."""
        # Bounded, so that requests do not delay the cycles.
        for _ in range(PER_WAKE_UP):
            try:
                # SOCK_SEQPACKET keeps the borders of messages, so one recv is one request.
                message = self._sock.recv(_MAX_MESSAGE)
            except OSError:
                return
            if not message:
                return
            try:
                request = self._decoder.decode(message)
            except ValueError as exc:
                self._refuse(message, exc)
                continue
            match request:
                case Cancel():
                    self._cancel(request.id)
                case Ping():
                    self.publish()
                    self._send(EngineReply(id=request.id))
                case Configure() | SetState():
                    self._serve_station(
                        request, now_ns, partial(self._reply_for_station, request.id)
                    )
                case _:
                    self._serve_bus(request, now_ns)

    def _refuse(self, message: bytes, reason: ValueError) -> None:
        """Count a malformed request, and answer it if it has a number."""
        self.malformed += 1
        try:
            number = msgspec.msgpack.decode(message, type=_Numbered).id
        except ValueError:
            return
        error = BusError(f"malformed request: {reason}")
        self._send(EngineReply(id=number, error=to_record(error)))

    def _reply_for_station(self, number: int, error: EapError | None) -> None:
        record = None if error is None else to_record(EngineRefusedError(str(error)))
        self._send(EngineReply(id=number, error=record))

    def _serve_bus(self, request: BusRequest, now_ns: int) -> None:
        self._cancel(request.id)  # a requester that used the number before has gone
        if request.bus not in self._buses:
            error = BusError(f"there is no bus {request.bus}: it was removed from the plant")
            self._send(EngineReply(id=request.id, error=to_record(error)))
            return
        bus, publisher = self._buses[request.bus]
        try:
            match request:
                case DescribeBus():
                    self._reply(
                        request, EngineReply(id=request.id, report=self._report(bus, now_ns))
                    )
                case ForgetFaults():
                    bus.forget_past()
                    self._reply(request, EngineReply(id=request.id))
                case Republish():
                    publisher.reset()
                    self._reply(request, EngineReply(id=request.id))
                case ExchangeMailbox():
                    self._exchange(bus, request, now_ns)
                case ExchangeDatagrams():
                    self._transfer(bus, request, now_ns)
                case BringSlaves():
                    self._bring(bus, request, now_ns)
        except EapError as exc:
            self._reply(request, EngineReply(id=request.id, error=to_record(exc)))

    def _reply(self, request: BusRequest, reply: EngineReply) -> None:
        """Reply to a request behind the changes that it made, or its sender has not received."""
        if request.bus in self._buses:
            self._buses[request.bus][1].flush()
        self._send(reply)

    def _forward(self, bus: int, message: Unsolicited) -> None:
        """Forward an unsolicited message of a slave on the bus numbered *bus*."""
        self._send(UnsolicitedMessage(bus, message))

    def _report(self, bus: EngineBus, now_ns: int) -> BusReport:
        return msgspec.structs.replace(
            report_bus(bus, now_ns), malformed=self.malformed, dropped=self.dropped
        )

    def _exchange(self, bus: EngineBus, request: ExchangeMailbox, now_ns: int) -> None:
        self._check_limits((request.bus, request.station))
        task = bus.master.converse(
            request.station,
            _one_exchange(request.request),
            now_ns,
            name=f"{request.request.type.name} request",
            requester=self,
        )
        self._watch(bus, request, request.station, task, _with_message, now_ns)

    def _transfer(self, bus: EngineBus, request: ExchangeDatagrams, now_ns: int) -> None:
        self._check_limits((request.bus, 0))
        procedure = _one_step(check_datagrams(request.datagrams))
        # One step only: a requester that dies in the middle leaves nothing under way on the bus.
        task = bus.master.run(procedure, now_ns, "a transfer")
        self._watch(bus, request, 0, task, _with_replies, now_ns)

    def _bring(self, bus: EngineBus, request: BringSlaves, now_ns: int) -> None:
        self._check_limits((request.bus, request.station))
        task = (
            bring_one(bus.master, request.station, request.target, now_ns)
            if request.station
            else bring_all(bus.master, request.target, now_ns)
        )
        self._watch(bus, request, request.station, task, _with_nothing, now_ns)

    def _check_limits(self, slave_key: _SlaveKey) -> None:
        if len(self._pending) >= MAX_OUTSTANDING:
            raise BusError(f"{MAX_OUTSTANDING} requests are under way already")
        if self._per_slave[slave_key] >= MAX_PER_SLAVE:
            raise BusError(
                f"{MAX_PER_SLAVE} requests to slave {slave_key[1]} are under way already"
            )

    def _watch(
        self,
        bus: EngineBus,
        request: BusRequest,
        station: int,
        task: Task[T],
        reply_with: Callable[[int, T], EngineReply],
        now_ns: int,
    ) -> None:
        """Reply when *task* is done, and keep it until then."""
        slave_key = request.bus, station
        self._pending[request.id] = _PendingRequest(task, slave_key)
        self._per_slave[slave_key] += 1

        def done(task: Task[T]) -> None:
            if self._forget(request.id, task):
                error = task.error
                self._reply(
                    request,
                    EngineReply(id=request.id, error=to_record(error))
                    if error is not None
                    else reply_with(request.id, task.result()),
                )

        task.watch(done)
        bus.keep(task, now_ns)

    def _cancel(self, number: int) -> None:
        pending = self._pending.get(number)
        if pending is not None:
            self._forget(number, pending.task)
            pending.task.cancel()

    def _forget(self, number: int, task: Task[Any]) -> bool:
        """Return whether *task* was still waited for."""
        pending = self._pending.get(number)
        if pending is None or pending.task is not task:
            return False
        del self._pending[number]
        self._per_slave[pending.slave_key] -= 1
        if not self._per_slave[pending.slave_key]:
            del self._per_slave[pending.slave_key]
        return True

    def _send(self, message: EngineMessage) -> bool:
        """Send a message; return False and drop it if there is no room."""
        try:
            # The socket does not block: the cycles never wait for services to read.
            self._sock.send(msgspec.msgpack.encode(message))
        except OSError:
            self.dropped += not isinstance(message, BusChange)  # that one is built anew
            return False
        return True


def _with_message(number: int, message: MailboxMessage) -> EngineReply:
    return EngineReply(id=number, message=message)


def _with_replies(number: int, replies: tuple[DatagramReply, ...]) -> EngineReply:
    return EngineReply(id=number, replies=replies)


def _with_nothing(number: int, _: None) -> EngineReply:
    return EngineReply(id=number)


def check_datagrams(datagrams: Sequence[DatagramRequest]) -> list[DatagramRequest]:
    """Return the datagrams to send, with tries in bounds.

    Raises:
        BusError: they are too many, one of them fits no frame, or would disturb the slaves.
    """
    if not 1 <= len(datagrams) <= MAX_DATAGRAMS:
        raise BusError(f"{len(datagrams)} datagrams, expected 1 to {MAX_DATAGRAMS}")
    return [_check_datagram(each) for each in datagrams]


def _check_datagram(wanted: DatagramRequest) -> DatagramRequest:
    adp, ado, size = wanted.adp, wanted.ado, len(wanted.data)
    if wanted.command not in _ALLOWED:
        names = ", ".join(sorted(each.name for each in _ALLOWED))
        raise BusError(
            f"datagram with command {wanted.command:d}: it would disturb the slaves while they"
            f" exchange process data; expected one of {names}"
        )
    if not (0 <= adp <= 0xFFFF and 0 <= ado <= 0xFFFF and 1 <= size <= MAX_DATA):
        raise BusError(
            f"datagram to 0x{adp:X}:0x{ado:X} with {size} bytes, expected addresses of 16"
            f" bits and 1 to {MAX_DATA} bytes"
        )
    # Bounded: a datagram that is lost for good would occupy the bus with its retries.
    tries = min(max(wanted.tries, AS_SET), MAX_TRIES)
    return wanted if tries == wanted.tries else replace(wanted, tries=tries)


def _one_exchange(request: MailboxRequest) -> Conversation[MailboxMessage]:
    return (yield request)


def _one_step(datagrams: Sequence[DatagramRequest]) -> Procedure[tuple[DatagramReply, ...]]:
    replies, _ = yield datagrams
    return tuple(replies)


def bring_one(master: Master, station: int, target: AlState, now_ns: int) -> Task[None]:
    """Bring one slave to *target*, where it is kept.

    Raises:
        BusError: there is no such slave, a transition of it is under way, or the bus has no process
            data yet.
    """
    if target in WITH_PROCESS_DATA and master.cycle is None and station in master.slaves:
        raise BusError(
            f"slave {station}: the process data of this bus is not laid out, for its slaves never"
            f" were beyond PREOP: bring all of them to {target.name} at once"
        )
    return master.request_state(station, target, now_ns)


def bring_all(master: Master, target: AlState, now_ns: int) -> Task[None]:
    """Bring all slaves to *target*, where they are kept; done when the last one is.

    Raises BusError if no slaves are known.
    """
    slaves = list(master.slaves.values())
    if not slaves:
        raise BusError("the bus is not up: no slave is known")
    if target in WITH_PROCESS_DATA and master.cycle is None:
        return master.bring_up(now_ns, target)
    return _AllSlaves(master, slaves, target, now_ns).task


class _AllSlaves:
    """Task that is done when all slaves of a bus are in a state."""

    def __init__(
        self, master: Master, slaves: Sequence[BusSlave], target: AlState, now_ns: int
    ) -> None:
        self.task: Task[None] = Task(f"bringing all slaves to {target.name}", self._stop)
        self._missing = len(slaves)
        self._errors: list[tuple[str, EapError]] = []
        self._tasks: list[Task[None]] = []
        for slave in slaves:
            try:
                task = master.request_state(slave.station, target, now_ns)
            except BusError as exc:
                self._end(f"{slave.name} ({slave.station})", exc)
            else:
                self._tasks.append(task)
                task.watch(partial(self._take, f"{slave.name} ({slave.station})"))

    def _take(self, name: str, task: Task[None]) -> None:
        self._end(name, task.error)

    def _end(self, name: str, error: EapError | None) -> None:
        self._missing -= 1
        if error is not None:
            self._errors.append((name, error))
        if self._missing or self.task.is_done:
            return
        if not self._errors:
            self.task.finish(None)
        else:
            self.task.fail(join_errors(self._errors))

    def _stop(self) -> None:
        for task in self._tasks:
            task.cancel()
