"""The mailbox gateway of one bus (ETG.8200): many clients, one master and its slaves.

Whoever asks is answered: by the slave, by the master's dictionary, or with an error in the protocol
of the request.  Requests of a client to different slaves or protocols do not wait for each other.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable
from functools import partial
from time import monotonic_ns
from typing import NamedTuple, TypeAlias, TypeVar

from devicebus.mailbox.counter import next_counter
from eap.aoe.access import AccessList
from eap.aoe.ads_operation import Operation
from eap.aoe.judged import AuditedOperation, AuditEntry
from eap.aoe.spec import AccessService
from eap.aoe.way import Way
from eap.appliance.bus_request import Heard
from eap.appliance.services.gateway.dialect_desk import DialectDesk
from eap.appliance.services.gateway.eoe_listeners import EoeListeners
from eap.appliance.services.gateway.master_session import MasterSession
from eap.appliance.services.gateway.slave_book import SlaveBook
from eap.appliance.services.gateway.slave_link import SlaveLink
from eap.appliance.services.gateway.slave_session import (
    Reply,
    SlaveSession,
    find_refusal,
)
from eap.appliance.services.gateway.tally import Tally
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader
from eap.codec.mailbox import MailboxHeader, MailboxType, encode_frame
from eap.gateway import dialect
from eap.gateway.address import MASTER_ADDRESS, AddressMap, Group, Master, Slave
from eap.gateway.ledger import Admission, ClientLimits, Ledger
from eap.gateway.refusal import Reason, refuse
from eap.gateway.rights import operation_of
from eap.ids import NetId

ANSWER_S = 0.9
"""How long an answer may take: before a usual client gives up."""
MAX_SESSIONS = 512
MASTER_PORT = 0xFFFF
"""AMS port by which rules name the master itself."""
NOBODY = NetId(bytes(6))
"""Source NetID of who has none."""

Send: TypeAlias = Callable[[bytes], None]
"""Sends a frame back to who sent a request, now or later."""

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


class _Request(NamedTuple):
    header: MailboxHeader
    body: bytes
    way: Way
    send: Send


_Key: TypeAlias = tuple[Way, int, MailboxType]
S = TypeVar("S", SlaveSession, MasterSession)
Sessions: TypeAlias = dict[_Key, S]


class MailboxGateway:
    """A gateway.

    Args:
        bus: Its slaves.
        open_master: Begins a session with the master's dictionary.
        access: Who may do what.
        settings: How it behaves.
        addresses: Beside those of the standard.

    Attributes:
        tally: What it did.
        on_audit: Called with each change that begins, and with each refusal.
    """

    def __init__(
        self,
        bus: SlaveLink,
        open_master: Callable[[], MasterSession],
        access: AccessList,
        settings: Settings,
        addresses: AddressMap | None = None,
    ) -> None:
        self.tally = Tally()
        self.on_audit: list[Callable[[AuditEntry], None]] = []
        self.ledger = Ledger(settings.limits)
        self._bus = bus
        self._open_master = open_master
        self._access = access
        self._settings = settings
        self._addresses = addresses or AddressMap()
        self._book = SlaveBook(bus.describe)
        self._dialect = DialectDesk(
            bus, self._book, self._may, open_master, settings.room, settings.answer_s
        )
        self._slaves: Sessions[SlaveSession] = {}
        self._masters: Sessions[MasterSession] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._listeners = EoeListeners()
        self._counter = 0
        bus.listen(self._take_unasked)

    def receive(
        self, header: MailboxHeader, body: bytes, way: Way, send: Send
    ) -> asyncio.Task[None] | None:
        """Take a request; its answers go back by *send*, until the task that is returned is done.

        Args:
            header: Of the mailbox message.
            body: What follows it.
            way: Connection, or address, of the client.
            send: Takes whole frames.
        """
        frame = header.encode() + body
        admission = self.ledger.admit(way, frame, monotonic_ns())
        if admission is Admission.REPEATED:
            return None
        request = _Request(header, body, way, send)
        if admission is Admission.CROWDED:
            self._refuse(request, Reason.CROWDED)
            return None
        task = asyncio.get_running_loop().create_task(self._serve(request))
        self._tasks.add(task)
        task.add_done_callback(partial(self._done, way, frame))
        return task

    def connection_closed(self, way: Way) -> None:
        """Forget a client, and end what it had under way."""
        self.ledger.forget(way)
        self._listeners.forget(way)
        for key in [key for key in self._slaves if key[0] == way]:
            self._slaves.pop(key).close()
        for key in [key for key in self._masters if key[0] == way]:
            self._masters.pop(key).close()

    async def wait_below(self, way: Way, count: int) -> None:
        """Wait until fewer than *count* requests of a client wait."""
        while self.ledger.waiting(way) >= count and self._tasks:
            await asyncio.wait(self._tasks, return_when=asyncio.FIRST_COMPLETED)

    async def wait_idle(self) -> None:
        """Wait until everybody has an answer."""
        while self._tasks:
            await asyncio.wait(self._tasks)

    async def close(self) -> None:
        """End everything that is under way."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for way in {key[0] for key in (*self._slaves, *self._masters)}:
            self.connection_closed(way)

    def _done(self, way: Way, frame: bytes, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        self.ledger.answered(way, frame)
        if not task.cancelled() and (error := task.exception()) is not None:
            logger.error("gateway: a request of %s failed", way, exc_info=error)

    async def _serve(self, request: _Request) -> None:
        kind = dialect.kind_of(request.header)
        if kind is not None:
            await self._serve_dialect(request, kind)
            return
        if request.header.type is MailboxType.ERR:
            self._refuse(request, Reason.SERVICE)
            return
        stations = await self._stations(request.header.address)
        found = self._addresses.resolve(request.header.address, stations)
        if not isinstance(found, Group):
            await self._ask(request, found, request.header.address)
        elif not found.members:
            self._refuse(request, Reason.NO_SLAVE)
        else:
            members = ((self._addresses.resolve(each, stations), each) for each in found.members)
            await asyncio.gather(
                *(self._ask(request, one, address, is_group=True) for one, address in members)
            )

    async def _stations(self, address: int) -> tuple[int, ...]:
        """Return the slaves there are, as far as that matters for *address*."""
        if address == MASTER_ADDRESS:
            return ()
        return await self._book.stations()

    async def _ask(
        self, request: _Request, found: object, address: int, *, is_group: bool = False
    ) -> None:
        """Ask the master or one slave, and answer from *address*."""
        kind, body = request.header.type, request.body
        start_ns = monotonic_ns()
        operation = operation_of(kind, body)
        station = found.station if isinstance(found, Slave) else MASTER_ADDRESS
        if not self._may(request.way, station, operation, by_rule=is_group):
            replies = [Reply(*refuse(kind, body, Reason.DENIED), reason=Reason.DENIED)]
        elif isinstance(found, Slave):
            replies = await self._ask_slave(request, station, is_step=operation is None)
        elif isinstance(found, Master):
            key = request.way, station, kind
            master = self._session(self._masters, key, self._open_master)
            replies = await master.ask(kind, body)
        else:
            text = "the slave of another station is reached by AoE"
            replies = [Reply(*refuse(kind, body, Reason.NO_SLAVE, text), reason=Reason.NO_SLAVE)]
        self.tally.note(station, kind, [each.reason for each in replies], monotonic_ns() - start_ns)
        self._answer(request, address, replies)

    async def _ask_slave(self, request: _Request, station: int, *, is_step: bool) -> list[Reply]:
        kind, body = request.header.type, request.body
        slave = await self._book.find(station)
        if isinstance(slave, Reason):
            return [Reply(*refuse(kind, body, slave), reason=slave)]
        reason = find_refusal(kind, body, slave)
        if reason is not None:
            return [Reply(*refuse(kind, body, reason), reason=reason)]

        if kind is MailboxType.EOE:
            address, now_ns = request.header.address, monotonic_ns()
            self._listeners.note(station, request.way, address, request.send, now_ns)

        def begin() -> SlaveSession:
            talk = partial(self._bus.open_talk, station, kind, request.way)
            return SlaveSession(kind, slave, talk, answer_s=self._settings.answer_s)

        session = self._session(self._slaves, (request.way, station, kind), begin)
        return await session.ask(body, is_step=is_step)

    def _take_unasked(self, message: Heard) -> None:
        """Hand an Ethernet frame of a slave to the clients that talk EoE to it."""
        if message.kind != MailboxType.EOE:
            return
        for listener in self._listeners.of(message.station, monotonic_ns()):
            header = MailboxHeader(
                0, listener.address, type=MailboxType.EOE, counter=self._next_counter()
            )
            listener.send(encode_frame(header, message.data))

    def _session(self, sessions: Sessions[S], key: _Key, begin: Callable[[], S]) -> S:
        session = sessions.pop(key, None)
        if session is None:
            if len(sessions) >= MAX_SESSIONS:
                _drop_oldest(sessions)
            session = begin()
        sessions[key] = session  # at the end: at the front is who has asked nothing for longest
        return session

    def _may(
        self, way: Way, station: int, operation: Operation | None, *, by_rule: bool = False
    ) -> bool:
        """Say whether a client may have it done; *by_rule*: a change only if a rule says so."""
        if operation is None:
            return True  # a step of what was judged when it began
        port = station or MASTER_PORT
        grants = self._access.grants(way, NOBODY, self._settings.net_id, port)
        verdict = grants.judge(operation)
        if by_rule and verdict.service is not AccessService.READ and not verdict.is_by_rule:
            why = "only a rule allows it for all slaves at once"
            verdict = verdict._replace(is_allowed=False, why=why)
        result = None if verdict.is_allowed else AdsError.ACCESS_DENIED
        audited = AuditedOperation(operation, verdict, result)
        if audited.is_told:
            header = AmsHeader(self._settings.net_id, port, NOBODY, 0, 0)
            for write in self.on_audit:
                write(AuditEntry(way, header, "", (audited,)))
        return verdict.is_allowed

    async def _serve_dialect(self, request: _Request, kind: MailboxType) -> None:
        address, start_ns = request.header.address, monotonic_ns()
        answer, reason = await self._dialect.answer(kind, address, request.body, request.way)
        self.tally.note(address, kind, [reason], monotonic_ns() - start_ns)
        if not (self._settings.is_silent and reason is not None):
            request.send(encode_frame(dialect.encode_header(kind, address), answer))

    def _refuse(self, request: _Request, reason: Reason) -> None:
        kind = request.header.type
        replies = [Reply(*refuse(kind, request.body, reason), reason=reason)]
        self.tally.note(request.header.address, kind, [reason], 0)
        self._answer(request, request.header.address, replies)

    def _answer(self, request: _Request, address: int, replies: Iterable[Reply]) -> None:
        for reply in replies:
            if reply.reason is not None and self._settings.is_silent:
                continue
            counter = reply.counter or self._next_counter()
            header = MailboxHeader(0, address, type=reply.type, counter=counter)
            request.send(encode_frame(header, reply.body))

    def _next_counter(self) -> int:
        self._counter = next_counter(self._counter)
        return self._counter


def _drop_oldest(sessions: Sessions[S]) -> None:
    idle = (key for key, each in sessions.items() if not each.is_running)
    sessions.pop(next(idle, next(iter(sessions)))).close()
