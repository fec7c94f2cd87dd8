"""Where services asks the engine for something, on a bus step by step.

Neither side waits for the other: a request that cannot be taken is refused at once, and an answer
that services does not read is dropped.
"""

from __future__ import annotations

import os
import socket
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias, TypeVar

import msgspec

from devicebus.errors import BusError
from devicebus.mailbox.conversation import MailboxMessage
from devicebus.master.access import DatagramReply
from devicebus.master.mailboxes import Unsolicited
from devicebus.master.task import Task
from devicebus.wire.alstatus import AlState
from eap.appliance.bus_failure import to_failure
from eap.appliance.bus_request import (
    Answer,
    AskMailbox,
    Bring,
    BusChange,
    BusReport,
    BusRequest,
    Cancel,
    Describe,
    Failure,
    Forget,
    Heard,
    Hello,
    Outcome,
    Ping,
    Republish,
    Request,
    Transfer,
)
from eap.appliance.engine.bus_publisher import BusPublisher
from eap.appliance.engine.bus_report import report_bus
from eap.appliance.engine.bus_step import one_ask, one_step, to_accesses, to_ask
from eap.appliance.engine.bus_target import bring_all, bring_one
from eap.appliance.engine.engine_bus import EngineBus
from eap.appliance.station_request import Configure, SetState, StationRequest
from eap.errors import EapError

T = TypeVar("T")

PER_WAKE_UP = 16
MAX_OUTSTANDING = 1024
MAX_PER_SLAVE = 64
_MAX_MESSAGE = 1 << 18
_Place = tuple[int, int]
ServeStation: TypeAlias = Callable[[StationRequest, int, Callable[[EapError | None], None]], None]


class _Errand(NamedTuple):
    """A request that is under way."""

    task: Task[Any]
    place: _Place
    """Bus and station, 0 for a bus as a whole."""


class BusDesk:
    """Takes requests from *sock* and answers them.

    Args:
        sock: The engine's end of the pair with services.
        buses: By their numbers in requests.
        serve_station: Does what is asked for with a station, and says when it is done.

    Attributes:
        malformed: Messages that were none.
        dropped: Answers that services did not take.
    """

    def __init__(
        self, sock: socket.socket, buses: Sequence[EngineBus], serve_station: ServeStation
    ) -> None:
        self.malformed = 0
        self.dropped = 0
        self._sock = sock
        self._buses = buses
        self._publishers = [
            BusPublisher(number, bus, self._send) for number, bus in enumerate(buses)
        ]
        self._serve_station = serve_station
        self._decoder = msgspec.msgpack.Decoder(Request)
        self._errands: dict[int, _Errand] = {}
        self._places: Counter[_Place] = Counter()
        sock.setblocking(False)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when there is a request."""
        return self._sock.fileno()

    def close(self) -> None:
        """Let go of the socket."""
        self._sock.close()

    def greet(self) -> None:
        """Say that a new engine is here."""
        self._send(Hello(os.getpid()))

    def tell(self, bus: int, message: Unsolicited) -> None:
        """Pass on what a slave of the bus numbered *bus* sent unasked."""
        self._send(Heard(bus, message.station, message.type, message.data))

    def publish(self) -> None:
        """Send what has changed on the buses."""
        for each in self._publishers:
            each.flush()

    def serve(self, now_ns: int) -> None:
        """Take a few of the requests that wait."""
        for _ in range(PER_WAKE_UP):
            try:
                message = self._sock.recv(_MAX_MESSAGE)
            except OSError:
                return
            if not message:
                return
            try:
                request = self._decoder.decode(message)
            except msgspec.MsgspecError:
                self.malformed += 1
                continue
            match request:
                case Cancel():
                    self._cancel(request.id)
                case Ping():
                    self.publish()
                    self._send(Answer(id=request.id))
                case Configure() | SetState():
                    self._serve_station(request, now_ns, partial(self._reply, request.id))
                case _:
                    self._serve_bus(request, now_ns)

    def _reply(self, number: int, error: EapError | None) -> None:
        failure = None if error is None else Failure(type(error).__name__, str(error))
        self._send(Answer(id=number, failure=failure))

    def _serve_bus(self, request: BusRequest, now_ns: int) -> None:
        self._cancel(request.id)  # whoever used the number before does not wait any more
        if not 0 <= request.bus < len(self._buses):
            error = BusError(f"there is no bus {request.bus}, there are {len(self._buses)}")
            self._send(Answer(id=request.id, failure=to_failure(error)))
            return
        bus = self._buses[request.bus]
        try:
            match request:
                case Describe():
                    self._answer(request, Answer(id=request.id, report=self._report(bus, now_ns)))
                case Forget():
                    bus.forget_past()
                    self._answer(request, Answer(id=request.id))
                case Republish():
                    self._publishers[request.bus].reset()
                    self._answer(request, Answer(id=request.id))
                case AskMailbox():
                    self._ask(bus, request, now_ns)
                case Transfer():
                    self._transfer(bus, request, now_ns)
                case Bring():
                    self._bring(bus, request, now_ns)
        except EapError as exc:
            self._answer(request, Answer(id=request.id, failure=to_failure(exc)))

    def _answer(self, request: BusRequest, answer: Answer) -> None:
        """Answer a request behind the changes that it has made, or its sender has not seen."""
        self._publishers[request.bus].flush()
        self._send(answer)

    def _report(self, bus: EngineBus, now_ns: int) -> BusReport:
        return msgspec.structs.replace(
            report_bus(bus, now_ns), malformed=self.malformed, dropped=self.dropped
        )

    def _ask(self, bus: EngineBus, request: AskMailbox, now_ns: int) -> None:
        self._check_room((request.bus, request.station))
        ask = to_ask(request)
        task = bus.master.converse(
            request.station, one_ask(ask), now_ns, name=f"{ask.type.name} request", requester=self
        )
        self._watch(bus, request, request.station, task, _message_answer, now_ns)

    def _transfer(self, bus: EngineBus, request: Transfer, now_ns: int) -> None:
        self._check_room((request.bus, 0))
        task = bus.master.run(one_step(to_accesses(request)), now_ns, "a transfer")
        self._watch(bus, request, 0, task, _outcomes_answer, now_ns)

    def _bring(self, bus: EngineBus, request: Bring, now_ns: int) -> None:
        self._check_room((request.bus, request.station))
        try:
            target = AlState(request.target)
        except ValueError:
            raise BusError(
                f"there is no state {request.target}, expected 1, 2, 3, 4 or 8"
            ) from None
        task = (
            bring_one(bus.master, request.station, target, now_ns)
            if request.station
            else bring_all(bus.master, target, now_ns)
        )
        self._watch(bus, request, request.station, task, _plain_answer, now_ns)

    def _check_room(self, place: _Place) -> None:
        if len(self._errands) >= MAX_OUTSTANDING:
            raise BusError(f"{MAX_OUTSTANDING} requests are under way already")
        if self._places[place] >= MAX_PER_SLAVE:
            raise BusError(f"{MAX_PER_SLAVE} requests to slave {place[1]} are under way already")

    def _watch(
        self,
        bus: EngineBus,
        request: AskMailbox | Transfer | Bring,
        station: int,
        task: Task[T],
        answer: Callable[[int, T], Answer],
        now_ns: int,
    ) -> None:
        """Answer when *task* is done, and remember it until then."""
        place = request.bus, station
        self._errands[request.id] = _Errand(task, place)
        self._places[place] += 1

        def done(task: Task[T]) -> None:
            if self._forget(request.id, task):
                error = task.error
                self._answer(
                    request,
                    Answer(id=request.id, failure=to_failure(error))
                    if error is not None
                    else answer(request.id, task.result()),
                )

        task.watch(done)
        bus.keep(task, now_ns)

    def _cancel(self, number: int) -> None:
        errand = self._errands.get(number)
        if errand is not None:
            self._forget(number, errand.task)
            errand.task.cancel()

    def _forget(self, number: int, task: Task[Any]) -> bool:
        """Return whether somebody still waited for *task*."""
        errand = self._errands.get(number)
        if errand is None or errand.task is not task:
            return False
        del self._errands[number]
        self._places[errand.place] -= 1
        if not self._places[errand.place]:
            del self._places[errand.place]
        return True

    def _send(self, message: Answer | Hello | Heard | BusChange) -> bool:
        """Send a message; return False and drop it if there is no room."""
        try:
            self._sock.send(msgspec.msgpack.encode(message))
        except OSError:
            self.dropped += not isinstance(message, BusChange)  # that one is built anew
            return False
        return True


def _message_answer(number: int, message: MailboxMessage) -> Answer:
    return Answer(id=number, data=message.data, counter=message.counter)


def _outcomes_answer(number: int, replies: list[DatagramReply]) -> Answer:
    outcomes = tuple(Outcome(reply.wkc, reply.data, reply.tries) for reply in replies)
    return Answer(id=number, outcomes=outcomes)


def _plain_answer(number: int, result: None) -> Answer:
    del result
    return Answer(id=number)
