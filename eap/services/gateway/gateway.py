"""The mailbox gateway of one bus (ETG.8200): many clients, one master and its slaves.

Every request is answered: by the slave, by the master's dictionary, or with an error in the
protocol of the request.  Requests of a client to different slaves or protocols do not wait for each
other.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from time import monotonic_ns
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

from msgspec.structs import replace

from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.mailboxes import Unsolicited
from devicebus.wire.sii import SiiProtocol
from eap.ads.request import Operation
from eap.ams.access import AccessList, host_of
from eap.ams.spec import TransportKind
from eap.codec.mailbox import MailboxHeader, MailboxType, decode_frame
from eap.errors import EngineGoneError
from eap.gateway import dialect
from eap.gateway.error_table import Cause
from eap.gateway.request_tracker import (
    ClientLimits,
    MemoryBudget,
    MemoryShare,
    RequestAdmission,
    RequestTracker,
    Ticket,
)
from eap.gateway.requests import (
    MASTER_ADDRESS,
    AddressMap,
    Destination,
    GatewayError,
    GroupAddress,
    MasterAddress,
    RemoteAddress,
    SlaveAddress,
    operation_of,
)
from eap.ids import Endpoint, NetId
from eap.runtime.engine_messages import SlaveDescription, no_mailbox
from eap.services.gateway.admission import (
    MASTER_PORT,
    GatewayAdmission,
    RequestDecision,
    RuleTarget,
    denial_cause,
    result_of,
)
from eap.services.gateway.dialect_handler import DialectHandler, DialectTarget
from eap.services.gateway.message_codecs import (
    EoeListener,
    EoeListeners,
    begins_to_listen,
    codec_for,
)
from eap.services.gateway.remote_ethernet import RemoteEthernet
from eap.services.gateway.reply_encoder import ErrorLog, GatewayRequest, ReplyEncoder, Send
from eap.services.gateway.sessions import (
    ClientSession,
    GatewayReply,
    MasterSession,
    SessionKey,
    SessionTable,
    cause_of,
    error_replies,
)
from eap.services.gateway.transfer_codecs import FileCodec
from eap.services.slaves.access import LocalSlave, SlaveAccess
from eap.services.slaves.bus_client import BusClient
from eap.services.slaves.remote_slave import RemoteSlave
from eap.services.tasks import TaskSet

GATEWAY_ANSWER_S = 0.9
"""Limit for an answer, below the second after which usual clients give up."""
STALL_S = 2.0
"""Wait of a slave for the client of a file after which that gives way to another client's."""

OpenRemote: TypeAlias = Callable[[RemoteAddress, float], RemoteSlave]
"""Returns access to a slave, or the master, of another station, with the limit for an answer."""

_REJECTIONS = {RequestAdmission.CROWDED: Cause.CROWDED, RequestAdmission.TOO_FAST: Cause.TOO_FAST}

_BY_TCP = f"{TransportKind.TCP}:"
"""Prefix of the names of TCP transports."""

logger = logging.getLogger(__name__)


class Settings(NamedTuple):
    """Behaviour of a gateway."""

    net_id: NetId
    """Of the bus port: targets of access rules."""
    answer_s: float = GATEWAY_ANSWER_S
    is_silent: bool = False
    """It sends no errors of its own, and answers only as slaves do."""
    max_size: int = 1486
    """Octets of the longest answer behind its headers: one datagram takes it."""
    limits: ClientLimits = ClientLimits()
    name: str = ""
    """Of the bus port, for log lines."""
    names: Mapping[int, str] = MappingProxyType({})
    """Names of remote slaves by virtual address."""


class MailboxGateway:
    """A gateway.

    Args:
        bus: With its slaves.
        open_master: Begins a session with the master's dictionary.
        access: Returns the access rules in force.
        settings: Its behaviour.
        addresses: Beside those of the standard.
        open_remote: Returns access to a slave of another station.

    Attributes:
        statistics: Requests and answers by slave and protocol.
        tracker: Requests by client.
        memory: Bytes of objects and messages that are under way.
        file_memory: Bytes of files that are fetched ahead; without max_size fewer are.
        admission: Access rules and audit.
        settings: As given.
        is_open: Whether it takes requests.
        dropped: Frames that were dropped while it did not.
    """

    def __init__(
        self,
        bus: BusClient,
        open_master: Callable[[], MasterSession],
        access: Callable[[], AccessList],
        settings: Settings,
        addresses: AddressMap,
        open_remote: OpenRemote,
    ) -> None:
        self.tracker = RequestTracker(settings.limits)
        self.memory, self.file_memory = MemoryBudget(), MemoryBudget()
        log = _log_of(settings)
        self._encoder = ReplyEncoder(self.tracker, log, is_silent=settings.is_silent)
        self.statistics = self._encoder.statistics
        self.admission = GatewayAdmission(access)
        self.settings = settings
        self.is_open = True
        self.dropped = 0
        self._bus = bus
        self._master = RuleTarget(settings.net_id, MASTER_PORT)
        self._open_master = open_master
        self._addresses = addresses
        self._open_remote = open_remote
        self._dialect = DialectHandler(self.admission, settings.max_size, settings.answer_s)
        self._masters: SessionTable[MasterSession] = SessionTable()
        self._slaves: SessionTable[ClientSession] = SessionTable()
        self._tasks = TaskSet(f"gateway {settings.name}")
        self._count = 0
        self._listeners = EoeListeners()
        self._ethernet = RemoteEthernet(settings.name, settings.max_size, self._send_fragment)
        bus.listen(self._forward_unsolicited)

    def change(self, settings: Settings, addresses: AddressMap) -> None:
        """Go on with other settings and addresses.

        Requests that are under way are finished with those before.  Transfers to virtual addresses
        that mean something else now are aborted.
        """
        changed = self._addresses.changed(addresses)
        self.settings, self._addresses = settings, addresses
        self.tracker.set_limits(settings.limits)
        self._encoder.change(_log_of(settings), is_silent=settings.is_silent)
        self._dialect = DialectHandler(self.admission, settings.max_size, settings.answer_s)
        if changed:
            self._slaves.close_to(changed)
            self._ethernet.forget_slaves()

    def start(self) -> None:
        """Take requests, again."""
        self.is_open = True

    async def stop(self) -> None:
        """Take no requests; active transfers are aborted, at the slaves too."""
        self.is_open = False
        await self.close()

    def transfers(self) -> list[SessionKey]:
        """Return the active transfers."""
        return [*self._slaves.running()]

    def receive(self, frame: bytes, endpoint: Endpoint, send: Send) -> asyncio.Task[None] | None:
        """Take a request; its answers go back by *send*, until the task that is returned is done.

        Args:
            frame: From its EtherCAT header on.
            endpoint: Connection, or address, of the client.
            send: Takes whole frames.

        Raises:
            TruncatedError: it is shorter than its headers say.
            MalformedError: its protocol is unknown.
        """
        header, body = decode_frame(frame)
        key = frame
        if endpoint.transport.startswith(_BY_TCP):  # TCP repeats nothing by itself
            self._count += 1
            key += self._count.to_bytes(8)
        now_ns = monotonic_ns()
        admission = self.tracker.admit(endpoint, key, now_ns)
        if admission is RequestAdmission.REPEATED:
            return None
        request = GatewayRequest(header, bytes(body), endpoint, send)
        if admission is not RequestAdmission.TAKEN:
            self._encoder.reply_error(request, _REJECTIONS[admission])
            return None
        if self._answer_cached(request, key, now_ns):
            return None
        request = replace(request, ticket=Ticket(self.tracker, endpoint, key))
        task = self._tasks.start(self._serve(request))
        task.add_done_callback(lambda _: request.release())
        return task

    def connection_closed(self, endpoint: Endpoint) -> None:
        """Remove a client, and abort its transfers."""
        self.tracker.forget(endpoint)
        self._listeners.forget(endpoint)
        self._ethernet.forget(endpoint)
        self._slaves.close_of(endpoint)
        self._masters.close_of(endpoint)

    async def wait_below(self, endpoint: Endpoint, count: int) -> None:
        """Wait until fewer than *count* requests of a client wait."""
        while self.tracker.waiting(endpoint) >= count and len(self._tasks):
            await self._tasks.wait_any()

    async def close(self) -> None:
        """Abort all requests and transfers."""
        await self._tasks.close()
        await self._ethernet.close()
        for endpoint in self.tracker.table():
            self.tracker.forget(endpoint)
            self._listeners.forget(endpoint)
        self._slaves.close()
        self._masters.close()

    async def _serve(self, request: GatewayRequest) -> None:
        kind = dialect.kind_of(request.header)
        if kind is not None:
            await self._serve_dialect(request, kind)
            return
        address = request.header.address
        if request.header.type is MailboxType.ERR:
            self._encoder.reply_error(request, Cause.SERVICE)
            return
        # The master's dictionary answers without the bus, which may be down.
        stations = () if address == MASTER_ADDRESS else await self._stations()
        match self._addresses.resolve(address, stations):
            case GroupAddress(members):
                if not members:
                    self._encoder.reply_error(request, Cause.NO_SLAVE)
                    return
                found = ((self._addresses.resolve(each, stations), each) for each in members)
                await asyncio.gather(
                    *(self._handle(request, one, each, is_group=True) for one, each in found)
                )
            case destination:
                await self._handle(request, destination, address)

    def _answer_cached(self, request: GatewayRequest, key: bytes, start_ns: int) -> bool:
        """Answer from the master's dictionary; return whether nothing had to be waited for."""
        header, body, endpoint = request.header, request.body, request.endpoint
        if header.address != MASTER_ADDRESS or header.type is not MailboxType.COE:
            return False
        if self.tracker.waiting(endpoint) > 1:
            return False  # what came first is answered first
        operation = operation_of(MailboxType.COE, body)
        key_of_session = SessionKey(endpoint, MASTER_ADDRESS, MailboxType.COE)
        master = self._masters.get(key_of_session, self._open_master)
        if not master.is_ready(operation):
            return False
        self.tracker.answered(endpoint, key)
        authorized = self._decide(endpoint, MASTER_ADDRESS, self._master, operation)
        replies = (
            master.handle_now(body)
            if authorized.is_allowed
            else error_replies(MailboxType.COE, body, denial_cause(authorized.decision))
        )
        self._finish(request, authorized, MASTER_ADDRESS, replies, start_ns)
        return True

    async def _handle(
        self,
        request: GatewayRequest,
        destination: Destination,
        address: int,
        *,
        is_group: bool = False,
    ) -> None:
        """Have the master or a slave answer a request, from *address*."""
        kind, body, endpoint = request.header.type, request.body, request.endpoint
        start_ns = monotonic_ns()
        operation = operation_of(kind, body)
        station = destination.station if isinstance(destination, SlaveAddress) else address
        target = self._target(destination)
        authorized = self._decide(endpoint, station, target, operation, by_rule=is_group)
        if authorized.is_allowed:
            try:
                replies = await self._forward(
                    request, destination, station, is_step=operation is None
                )
            except GatewayError as exc:
                replies = error_replies(kind, body, exc.cause)
        else:
            replies = error_replies(kind, body, denial_cause(authorized.decision))
        self._finish(request, authorized, address, replies, start_ns)

    async def _forward(
        self, request: GatewayRequest, destination: Destination, station: int, *, is_step: bool
    ) -> list[GatewayReply]:
        kind, body, endpoint = request.header.type, request.body, request.endpoint
        key = SessionKey(endpoint, station, kind)
        match destination:
            case MasterAddress():
                return await self._masters.get(key, self._open_master).handle(kind, body)
            case SlaveAddress():
                return await self._forward_to_slave(request, key, is_step=is_step)
            case RemoteAddress():
                sizes = MailboxSizes.of_data(self.settings.max_size)
                slave = self._open_remote(destination, self.settings.answer_s)
                if kind is MailboxType.EOE and begins_to_listen(body):
                    self._ethernet.add(station, slave, endpoint, request.send)
                begin = partial(self._begin, key, slave, sizes)
                return await self._slaves.get(key, begin).handle(body, is_step=is_step)
            case GroupAddress():  # a group within a group
                raise GatewayError(Cause.NO_SLAVE)

    def _decide(
        self,
        endpoint: Endpoint,
        station: int,
        target: RuleTarget,
        operation: Operation | None,
        *,
        by_rule: bool = False,
    ) -> RequestDecision:
        if operation is None or self.admission.may_read(endpoint, target, operation):
            return RequestDecision(station, target, None, None)
        decision = self.admission.decide(endpoint, target, operation, by_rule=by_rule)
        return RequestDecision(station, target, operation, decision)

    def _finish(
        self,
        request: GatewayRequest,
        authorized: RequestDecision,
        address: int,
        replies: Sequence[GatewayReply],
        start_ns: int,
    ) -> None:
        """Write the audit, count, and answer from *address*."""
        operation, decision = authorized.operation, authorized.decision
        # The audit comes first: no client may know of a change that the audit has not.
        if operation is not None and decision is not None:
            self.admission.record(
                request.endpoint, authorized.target, operation, decision, result_of(replies)
            )
        took_ns = monotonic_ns() - start_ns
        self._encoder.answer(request, authorized.station, address, replies, took_ns)

    def _target(self, destination: Destination) -> RuleTarget:
        """Return the name of a destination in access rules."""
        match destination:
            case RemoteAddress(net_id, port):
                return RuleTarget(net_id, port)
            case SlaveAddress(station):
                return RuleTarget(self.settings.net_id, station)
        return self._master

    async def _forward_to_slave(
        self, request: GatewayRequest, key: SessionKey, *, is_step: bool
    ) -> list[GatewayReply]:
        kind, body, station = key.kind, request.body, key.address
        slave = await self._find(station)
        check_slave(kind, body, slave)
        if kind is MailboxType.EOE and begins_to_listen(body):
            address, now_ns = request.header.address, monotonic_ns()
            self._listeners.add(station, request.endpoint, address, request.send, now_ns)
        session = self._slaves.get(key, partial(self._begin_local, key, slave))
        sizes = session.codec.sizes
        if (sizes.to_slave, sizes.to_master) != (slave.to_slave, slave.to_master):
            self._slaves.drop(key)  # the mailbox is another one than before, as in BOOT
            session = self._slaves.get(key, partial(self._begin_local, key, slave))
        replies = await session.handle(body, is_step=is_step)
        if isinstance(session.codec, FileCodec) and session.codec.waits_for_lock:
            self._end_stalls(key)
        return replies

    async def _stations(self) -> tuple[int, ...]:
        """Return the station addresses in the order of the bus, none while it is down."""
        with suppress(EngineGoneError):
            bus = await self._bus.view.current()
            return tuple(bus.slaves) if bus.is_up else ()
        return ()

    async def _find(self, station: int) -> SlaveDescription:
        """Return a slave; raise GatewayError if it cannot be reached."""
        try:
            bus = await self._bus.view.current()
            slave = bus.slaves.get(station)
            if not bus.is_reachable or slave is None or not slave.to_slave:
                # Clients that have just seen a slave come to PREOP send their requests at once.
                bus = await self._bus.view.confirm()
        except EngineGoneError:
            raise GatewayError(Cause.BUS_DOWN) from None
        if not bus.is_reachable:
            raise GatewayError(Cause.BUS_DOWN)
        if (found := bus.slaves.get(station)) is None:
            raise GatewayError(Cause.NO_SLAVE)
        return found

    def _begin_local(self, key: SessionKey, slave: SlaveDescription) -> ClientSession:
        sizes = MailboxSizes(slave.to_slave, slave.to_master)
        return self._begin(key, self._open_local(slave, key.endpoint), sizes)

    def _open_local(self, slave: SlaveDescription, endpoint: Endpoint) -> LocalSlave:
        return LocalSlave(self._bus, slave, endpoint, lock_s=self.settings.answer_s)

    def _begin(self, key: SessionKey, access: SlaveAccess, sizes: MailboxSizes) -> ClientSession:
        answer_s = self.settings.answer_s
        budget = self.file_memory if key.kind is MailboxType.FOE else self.memory
        memory = MemoryShare(budget, host_of(key.endpoint))
        # The rest of the time is for the probe of a station that lets a client wait.
        codec = codec_for(key.kind, access, sizes, memory, wait_s=answer_s / 3)
        return ClientSession(key.kind, codec, answer_s=answer_s)

    def _end_stalls(self, key: SessionKey) -> None:
        """Close files of other clients whose slave waits for them."""
        for other, session in self._slaves.of_slave(key.address, key.kind):
            codec = session.codec
            if isinstance(codec, FileCodec) and codec.stalled_s > STALL_S:
                logger.info(
                    "gateway %s: file of slave %d closed: %s paused for %g s while %s waits",
                    self.settings.name, key.address, other.endpoint.connection, STALL_S,
                    key.endpoint.connection,
                )  # fmt: skip
                session.close()

    def _forward_unsolicited(self, message: Unsolicited) -> None:
        """Send an Ethernet frame of a slave to the clients that talk EoE to it."""
        if message.type != MailboxType.EOE:
            return
        for listener in self._listeners.of_slave(message.station, monotonic_ns()):
            self._send_fragment(listener, message.data)

    def _send_fragment(self, listener: EoeListener, fragment: bytes) -> None:
        self._encoder.send(listener.send, listener.address, MailboxType.EOE, fragment)

    async def _serve_dialect(self, request: GatewayRequest, kind: MailboxType) -> None:
        address, start_ns = request.header.address, monotonic_ns()
        destination = self._addresses.resolve(address, ())
        if isinstance(destination, GroupAddress):
            destination = SlaveAddress(address)  # the dialect has no groups: no slave is there
        answer, cause = await self._dialect.answer(
            kind, request.body, request.endpoint, self._target(destination),
            partial(self._dialect_target, kind, destination, request.endpoint),
        )  # fmt: skip
        took_ns = monotonic_ns() - start_ns
        self._encoder.answer_dialect(request, kind, answer, cause, took_ns)

    async def _dialect_target(
        self, kind: MailboxType, destination: Destination, endpoint: Endpoint
    ) -> DialectTarget:
        match destination:
            case MasterAddress():
                return self._open_master()
            case RemoteAddress():
                return self._open_remote(destination, self.settings.answer_s)
            case SlaveAddress(station):
                slave = await self._find(station)
                check_slave(kind, b"", slave)
                return self._open_local(slave, endpoint)
        raise GatewayError(Cause.NO_SLAVE)


def _log_of(settings: Settings) -> ErrorLog:
    return ErrorLog(settings.name, settings.names, settings.answer_s)


def check_slave(kind: MailboxType, body: bytes, slave: SlaveDescription) -> None:
    """Raise GatewayError if a request cannot be sent to the slave at all."""
    if not slave.to_slave:
        raise GatewayError(cause_of(no_mailbox(slave)))
    if not slave.protocols & SiiProtocol.of(kind):
        raise GatewayError(Cause.NO_PROTOCOL)
    if len(body) + MailboxHeader.SIZE > slave.to_slave:
        raise GatewayError(Cause.TOO_LONG)
