"""The mailbox gateway of one bus (ETG.8200): many clients, one master and its slaves.

Whoever asks is answered: by the slave, by the master's dictionary, or with an error in the protocol
of the request.  Requests of a client to different slaves or protocols do not wait for each other.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from functools import partial
from time import monotonic_ns
from typing import NamedTuple

from msgspec.structs import replace

from eap.aoe.access import AccessList
from eap.aoe.ads_operation import Operation
from eap.aoe.spec import DoorKind
from eap.aoe.way import Way
from eap.appliance.bus_request import Heard
from eap.appliance.services.gateway.answering import Answering, Request, Send, refusals
from eap.appliance.services.gateway.dialect_desk import DialectDesk
from eap.appliance.services.gateway.eoe_listeners import EoeListeners
from eap.appliance.services.gateway.guard import (
    MASTER_PORT,
    Guard,
    Judged,
    Target,
    reason_of_refusal,
    result_of,
)
from eap.appliance.services.gateway.master_session import MasterSession
from eap.appliance.services.gateway.remote_link import LinkTo
from eap.appliance.services.gateway.remote_session import RemoteSession
from eap.appliance.services.gateway.sessions import SessionKey, Sessions
from eap.appliance.services.gateway.slave_book import SlaveBook
from eap.appliance.services.gateway.slave_session import (
    Reply,
    SlaveSession,
    find_refusal,
)
from eap.appliance.services.slaves.bus_mailboxes import BusMailboxes
from eap.codec.mailbox import MailboxType, decode_frame
from eap.gateway import dialect
from eap.gateway.address import MASTER_ADDRESS, AddressMap, Group, Master, RemoteSlave, Slave
from eap.gateway.ledger import Admission, ClientLimits, Ledger, Ticket
from eap.gateway.refusal import Reason
from eap.gateway.rights import operation_of
from eap.ids import NetId

ANSWER_S = 0.9
"""How long an answer may take: before a usual client gives up."""

_NOT_TAKEN = {Admission.CROWDED: Reason.CROWDED, Admission.TOO_FAST: Reason.TOO_FAST}

_BY_TCP = f"{DoorKind.TCP}:"
"""How the names of such doors begin."""

logger = logging.getLogger(__name__)


class Settings(NamedTuple):
    """How a gateway behaves."""

    net_id: NetId
    """Of the bus port: targets of access rules."""
    answer_s: float = ANSWER_S
    is_silent: bool = False
    """Whether it keeps its own errors to itself, and answers what slaves answer."""
    room: int = 1486
    """Octets of the longest answer behind its headers: one datagram takes it."""
    limits: ClientLimits = ClientLimits()
    name: str = ""
    """Of the bus port, for log lines."""


class MailboxGateway:
    """A gateway.

    Args:
        bus: Its slaves.
        open_master: Begins a session with the master's dictionary.
        access: Returns the rules by which is judged who may do what.
        settings: How it behaves.
        addresses: Beside those of the standard.
        link_to: Returns the way to a slave of another station.

    Attributes:
        tally: What it did, by slave and protocol.
        ledger: What it did, by client.
        guard: Judges requests, and has the audit written.
        settings: As given.
        is_open: Whether it takes requests.
        turned_away: Frames that came while it did not.
    """

    def __init__(
        self,
        bus: BusMailboxes,
        open_master: Callable[[], MasterSession],
        access: Callable[[], AccessList],
        settings: Settings,
        addresses: AddressMap,
        link_to: LinkTo,
    ) -> None:
        self.ledger = Ledger(settings.limits)
        self._answering = Answering(self.ledger, settings.name, is_silent=settings.is_silent)
        self.tally = self._answering.tally
        self.guard = Guard(access)
        self.settings = settings
        self.is_open = True
        self.turned_away = 0
        self._bus = bus
        self._master = Target(settings.net_id, MASTER_PORT)
        self._open_master = open_master
        self._addresses = addresses
        self._link_to = link_to
        self._book = SlaveBook(bus.describe)
        self._dialect = DialectDesk(
            bus, self._book, self.guard, open_master, link_to, settings.room,
            settings.answer_s,
        )  # fmt: skip
        self._slaves: Sessions[SlaveSession] = Sessions()
        self._masters: Sessions[MasterSession] = Sessions()
        self._remotes: Sessions[RemoteSession] = Sessions()
        self._tasks: set[asyncio.Task[None]] = set()
        self._count = 0
        self._listeners = EoeListeners()
        bus.listen(self._take_unasked)

    def start(self) -> None:
        """Take requests, again."""
        self.is_open = True

    async def stop(self) -> None:
        """Take no requests; what is under way is ended, at the slaves too."""
        self.is_open = False
        await self.close()

    def transfers(self) -> list[SessionKey]:
        """Return the transfers that are under way."""
        return [*self._slaves.running(), *self._remotes.running()]

    def receive(self, frame: bytes, way: Way, send: Send) -> asyncio.Task[None] | None:
        """Take a request; its answers go back by *send*, until the task that is returned is done.

        Args:
            frame: From its EtherCAT header on.
            way: Connection, or address, of the client.
            send: Takes whole frames.

        Raises:
            TruncatedError: it is shorter than its headers say.
            MalformedError: nobody knows its protocol.
        """
        header, body = decode_frame(frame)
        key = frame
        if way.door.startswith(_BY_TCP):  # what comes twice there was asked twice
            self._count += 1
            key += self._count.to_bytes(8)
        now_ns = monotonic_ns()
        admission = self.ledger.admit(way, key, now_ns)
        if admission is Admission.REPEATED:
            return None
        request = Request(header, bytes(body), way, send)
        if admission is not Admission.TAKEN:
            self._answering.refuse(request, _NOT_TAKEN[admission])
            return None
        if self._answer_at_once(request, key, now_ns):
            return None
        request = replace(request, ticket=Ticket(self.ledger, way, key))
        task = asyncio.get_running_loop().create_task(self._serve(request))
        self._tasks.add(task)
        task.add_done_callback(partial(self._done, request))
        return task

    def connection_closed(self, way: Way) -> None:
        """Forget a client, and end what it had under way."""
        self.ledger.forget(way)
        self._listeners.forget(way)
        self._slaves.close_of(way)
        self._masters.close_of(way)
        self._remotes.close_of(way)

    async def wait_below(self, way: Way, count: int) -> None:
        """Wait until fewer than *count* requests of a client wait."""
        while self.ledger.waiting(way) >= count and self._tasks:
            await asyncio.wait(self._tasks, return_when=asyncio.FIRST_COMPLETED)

    async def close(self) -> None:
        """End everything that is under way."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for way in self.ledger.table():
            self.ledger.forget(way)
            self._listeners.forget(way)
        self._slaves.close()
        self._masters.close()
        self._remotes.close()

    def _done(self, request: Request, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        request.give_back()
        if not task.cancelled() and (error := task.exception()) is not None:
            logger.error("gateway: a request of %s failed", request.way, exc_info=error)

    async def _serve(self, request: Request) -> None:
        kind = dialect.kind_of(request.header)
        if kind is not None:
            await self._serve_dialect(request, kind)
            return
        if request.header.type is MailboxType.ERR:
            self._answering.refuse(request, Reason.SERVICE)
            return
        stations = await self._stations(request.header.address)
        found = self._addresses.resolve(request.header.address, stations)
        if not isinstance(found, Group):
            await self._ask(request, found, request.header.address)
        elif not found.members:
            self._answering.refuse(request, Reason.NO_SLAVE)
        else:
            members = ((self._addresses.resolve(each, stations), each) for each in found.members)
            await asyncio.gather(
                *(self._ask(request, one, address, is_group=True) for one, address in members)
            )

    def _answer_at_once(self, request: Request, key: bytes, start_ns: int) -> bool:
        """Answer from the master's dictionary; return whether nothing had to be waited for."""
        header, body, way = request.header, request.body, request.way
        if header.address != MASTER_ADDRESS or header.type is not MailboxType.COE:
            return False
        if self.ledger.waiting(way) > 1:
            return False  # what came first is answered first
        operation = operation_of(MailboxType.COE, body)
        whose = SessionKey(way, MASTER_ADDRESS, MailboxType.COE)
        master = self._masters.take(whose, self._open_master)
        if not master.is_ready(operation):
            return False
        self.ledger.answered(way, key)
        judged = self._judge(way, MASTER_ADDRESS, self._master, operation)
        replies = (
            master.ask_now(body)
            if judged.is_allowed
            else refusals(MailboxType.COE, body, reason_of_refusal(judged.verdict))
        )
        self._finish(request, judged, MASTER_ADDRESS, replies, start_ns)
        return True

    async def _stations(self, address: int) -> tuple[int, ...]:
        """Return the slaves there are, as far as that matters for *address*."""
        if address == MASTER_ADDRESS:
            return ()
        return await self._book.stations()

    async def _ask(
        self, request: Request, found: object, address: int, *, is_group: bool = False
    ) -> None:
        """Ask the master or one slave, and answer from *address*."""
        kind, body, way = request.header.type, request.body, request.way
        start_ns = monotonic_ns()
        operation = operation_of(kind, body)
        station = found.station if isinstance(found, Slave) else address
        judged = self._judge(way, station, self._target(found), operation, by_rule=is_group)
        if not judged.is_allowed:
            replies = refusals(kind, body, reason_of_refusal(judged.verdict))
        elif isinstance(found, Slave):
            replies = await self._ask_slave(request, station, is_step=operation is None)
        elif isinstance(found, Master):
            master = self._masters.take(SessionKey(way, station, kind), self._open_master)
            replies = await master.ask(kind, body)
        elif isinstance(found, RemoteSlave):
            link, room = self._link_to(found), self.settings.room
            begin = partial(RemoteSession, kind, link, room=room)
            replies = await self._remotes.take(SessionKey(way, station, kind), begin).ask(body)
        else:  # a group within a group
            replies = refusals(kind, body, Reason.NO_SLAVE)
        self._finish(request, judged, address, replies, start_ns)

    def _judge(
        self,
        way: Way,
        station: int,
        target: Target,
        operation: Operation | None,
        *,
        by_rule: bool = False,
    ) -> Judged:
        if operation is None or self.guard.may_read(way, target, operation):
            return Judged(station, target, None, None)
        verdict = self.guard.judge(way, target, operation, by_rule=by_rule)
        return Judged(station, target, operation, verdict)

    def _finish(
        self,
        request: Request,
        judged: Judged,
        address: int,
        replies: Sequence[Reply],
        start_ns: int,
    ) -> None:
        """Tell the audit, count, and answer from *address*."""
        operation, verdict = judged.operation, judged.verdict
        if operation is not None and verdict is not None:
            self.guard.tell(request.way, judged.target, operation, verdict, result_of(replies))
        took_ns = monotonic_ns() - start_ns
        self._answering.answer(request, judged.station, address, replies, took_ns)

    def _target(self, found: object) -> Target:
        """Return by what rules name somebody."""
        if isinstance(found, RemoteSlave):
            return Target(found.net_id, found.port)
        port = found.station if isinstance(found, Slave) else MASTER_PORT
        return Target(self.settings.net_id, port)

    async def _ask_slave(self, request: Request, station: int, *, is_step: bool) -> list[Reply]:
        kind, body = request.header.type, request.body
        slave = await self._book.find(station)
        if isinstance(slave, Reason):
            return refusals(kind, body, slave)
        reason = find_refusal(kind, body, slave)
        if reason is not None:
            return refusals(kind, body, reason)

        if kind is MailboxType.EOE:
            address, now_ns = request.header.address, monotonic_ns()
            self._listeners.note(station, request.way, address, request.send, now_ns)

        def begin() -> SlaveSession:
            talk = partial(self._bus.open_talk, station, kind, request.way)
            return SlaveSession(kind, slave, talk, answer_s=self.settings.answer_s)

        session = self._slaves.take(SessionKey(request.way, station, kind), begin)
        return await session.ask(body, is_step=is_step)

    def _take_unasked(self, message: Heard) -> None:
        """Hand an Ethernet frame of a slave to the clients that talk EoE to it."""
        if message.kind != MailboxType.EOE:
            return
        for listener in self._listeners.of(message.station, monotonic_ns()):
            self._answering.send(listener.send, listener.address, MailboxType.EOE, message.data)

    async def _serve_dialect(self, request: Request, kind: MailboxType) -> None:
        address, start_ns = request.header.address, monotonic_ns()
        found = self._addresses.resolve(address, ())
        whom = Slave(address) if isinstance(found, Group) else found  # nobody has that address
        answer, reason = await self._dialect.answer(
            kind, whom, self._target(whom), request.body, request.way
        )
        took_ns = monotonic_ns() - start_ns
        self._answering.answer_dialect(request, kind, answer, reason, took_ns)
