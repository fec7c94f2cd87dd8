"""A gateway given any frames by two clients; its slave and its master are in memory."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Hashable, Iterator
from itertools import cycle
from typing import TypeVar, cast

from devicebus.errors import MailboxTimeoutError
from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.conversation import Conversation, MailboxMessage, MailboxRequest, drive_async
from devicebus.mailbox.foe_server import FoeServer, MemoryFile, MemoryStore
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.server import MailboxServer
from devicebus.mailbox.voe import VoeServer
from devicebus.master.mailboxes import Unsolicited
from devicebus.wire.sii import SiiProtocol
from eap.ads.request import Operation, OperationOutcome, Read, ReadWrite, accept_request
from eap.ams.access import AccessList
from eap.ams.spec import AccessRule, AccessService
from eap.codec.ams import AmsAnswer
from eap.codec.mailbox import (
    MailboxHeader,
    MailboxType,
    decode_frame,
    decode_message,
    encode_frame,
    encode_message,
)
from eap.gateway.request_tracker import ClientLimits
from eap.gateway.requests import AddressMap, RemoteAddress
from eap.ids import NetId
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RW, OdState, variable
from eap.runtime.engine_messages import SlaveDescription
from eap.runtime.handover import PortName
from eap.services.gateway.gateway import MailboxGateway, Settings
from eap.services.gateway.gateway_transport import GatewayTable, GatewayTransport
from eap.services.gateway.sessions import MasterSession
from eap.services.slaves.bus_client import BusClient, BusDescription, MailboxLock
from eap.services.slaves.remote_slave import RemoteSlave
from tools.fuzz.messages import cut

T = TypeVar("T")

_SIZES = MailboxSizes(40, 40)
_STATION = 1001
_VIRTUAL = 0x9001
"""A slave of another station."""
_ADDRESSES = (_STATION, 0, 0xFFFF, _STATION | 0x8000, 7, _VIRTUAL)
_SETTINGS = Settings(NetId(b"\1\2\3\4\5\6"), max_size=60, limits=ClientLimits(4, clients=1))
_EVERYTHING = (AccessRule("all", allow=True, services=(AccessService.READ, AccessService.WRITE)),)


class _Failures(logging.Handler):
    """Keeps the last exception that the gateway logged: it raises none."""

    found: BaseException | None = None

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info:
            self.found = record.exc_info[1]


def _op() -> OdState:
    return OdState.OP


class _Conversation:
    """One slave's mailbox, without a bus."""

    def __init__(self, box: MailboxServer) -> None:
        self._box = box

    async def exchange(self, handle: MailboxRequest) -> MailboxMessage:
        if not handle.listen:
            octets = encode_message(MailboxHeader(0, 0, type=handle.type), handle.request)
            self._box.receive_message(octets, 0)
        if not handle.expects_reply:
            return MailboxMessage(handle.type, b"")
        reply = self._box.next_message(0)
        if reply is None:
            raise MailboxTimeoutError("nothing comes")
        self._box.handle_read()
        header, body = decode_message(reply)
        return MailboxMessage(header.type, bytes(body), counter=header.counter)

    def abandon(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """There is always a turn."""


class _Link:
    """A bus of one slave."""

    def __init__(self, dictionary: ObjectDictionary) -> None:
        store = MemoryStore([MemoryFile("", bytes(90), max_size=200)], creates=True)
        self._box = MailboxServer(
            {
                MailboxType.COE: CoeServer(dictionary, _op, _SIZES),
                MailboxType.FOE: FoeServer(store, _SIZES),
                MailboxType.VOE: VoeServer(),
            },
            _SIZES,
        )

    @property
    def view(self) -> _Link:
        """Return what describes the bus."""
        return self

    async def current(self) -> BusDescription:
        slave = SlaveDescription(
            station=_STATION, name="", vendor=0, product=0, revision=0, serial=0, alias=0, state=8,
            target=8, to_slave=_SIZES.to_slave, to_master=_SIZES.to_master,
            protocols=SiiProtocol.COE | SiiProtocol.FOE | SiiProtocol.VOE,
        )  # fmt: skip
        return BusDescription(True, "", {_STATION: slave})

    async def confirm(self) -> BusDescription:
        return await self.current()

    async def lock_mailbox(
        self, station: int, kind: MailboxType, requester: Hashable, lock_s: float | None = None
    ) -> MailboxLock:
        return cast("MailboxLock", _Conversation(self._box))

    async def converse(
        self,
        station: int,
        conversation: Conversation[T],
        requester: Hashable,
        lock_s: float | None = None,
    ) -> T:
        return await drive_async(conversation, _Conversation(self._box).exchange)

    def listen(self, heard: Callable[[Unsolicited], None]) -> None:
        """It says nothing unasked."""


async def _nothing(index: int) -> None:
    """The values of the master are always current."""


async def _send_requests(port: int, command: int, body: bytes, *, timeout_s: float) -> AmsAnswer:
    """Read long values and a short file from another station, and take what is written there."""
    del port, timeout_s
    request = accept_request(command, body)
    if isinstance(request, AmsAnswer):
        return request
    outcomes = [OperationOutcome(data=_elsewhere(each)) for each in request.operations]
    return AmsAnswer(request.encode_answer(outcomes))


def _elsewhere(operation: Operation) -> bytes:
    match operation:
        case Read(offset=0xF020_0100):  # the slaves there are
            return b"\1\0" + _STATION.to_bytes(2, "little")
        case Read(offset=0x8000_0021 | 0x8000_0022):  # their mailboxes
            return _SIZES.to_slave.to_bytes(2, "little")
        case Read():
            return bytes(3000)
        case ReadWrite(length=length):
            return bytes(min(length, 100))
    return b""


def _frames(data: bytes) -> Iterator[bytes]:
    """Yield the octets as they are, then messages to each address in each protocol."""
    yield data
    kinds = cycle((*MailboxType,))
    for number, body in enumerate(cut(data)):
        address, counter = _ADDRESSES[len(body) % len(_ADDRESSES)], number % 8
        header = MailboxHeader(0, address, type=next(kinds), counter=counter)
        yield encode_frame(header, body)


async def _serve(data: bytes) -> None:
    dictionary = ObjectDictionary(
        [variable(0x1000, "A", "UDINT"), variable(0, "B", "BLOCK(90)", RW)]
    )
    link = RemoteSlave(_send_requests, _STATION, answer_s=1)
    gateway = MailboxGateway(
        cast("BusClient", _Link(dictionary)),
        lambda: MasterSession(
            dictionary, _SETTINGS.max_size, _nothing, lambda index: bool(index & 1)
        ),
        lambda: AccessList(_EVERYTHING),
        _SETTINGS,
        AddressMap({_VIRTUAL: RemoteAddress(_SETTINGS.net_id, 1001)}),
        lambda slave, answer_s: link,
    )
    table = GatewayTable()
    table.replace({PortName("fuzz", "bus0"): gateway})
    transport = GatewayTransport(table, {"fuzz": "udp:eap0"})
    answered: list[bytes] = []
    for frame, client in zip(_frames(data), cycle("ab"), strict=False):
        transport.receive(frame, client, lambda to, octets: answered.append(octets))
        await transport.wait_below(client, 1)
    for octets in answered:
        decode_frame(octets)
    await gateway.close()
    if gateway.transfers() or gateway.tracker.table():
        raise AssertionError("transfers or clients are left over")
    if held := gateway.memory.held + gateway.file_memory.held:
        raise AssertionError(f"{held} octets are held for nothing")


def fuzz_one(data: bytes) -> None:
    """Have all frames taken; nothing is raised, every answer is a frame, nothing stays."""
    failures = _Failures()
    logger = logging.getLogger("eap.services")
    logger.addHandler(failures)
    try:
        asyncio.run(_serve(data))
    finally:
        logger.removeHandler(failures)
    if failures.found is not None:
        raise failures.found
