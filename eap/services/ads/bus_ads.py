"""ADS services of one bus port: the master at port 0xFFFF, slaves at their station addresses.

Index groups are those of ETG.1020 (AoE) and of Ads.h of the TwinCAT SDK.  A group goes to the slave
by the mailbox protocol that serves it.  A group that no other protocol serves, or whose protocol
the slave does not support, is forwarded by AoE.

Rule 1: the operations of a request are executed one after the other.  An operation that does not
fit into the time of the request is answered with a timeout: routers and clients wait longer.
Rule 2: requests do not wait for each other here; the bus client queues them for the mailboxes.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Container
from functools import partial
from itertools import count, islice
from time import monotonic_ns
from typing import NamedTuple, TypeAlias

from devicebus.errors import MailboxTimeoutError, SoeError
from devicebus.wire.sii import SiiProtocol
from eap.ads.notifications import AdsClient
from eap.ads.request import (
    AdsRefusedError,
    Operation,
    OperationOutcome,
    Read,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
    Write,
    WriteControl,
    decode_outcome,
    encode_query,
)
from eap.ads.space import DeviceDataSpace, al_state_for, states_of
from eap.codec.ads import AdsDeviceInfo, AdsError, IndexGroup, SdoOffset, SoeOffset, device_name
from eap.codec.adsnotification import AddNotification
from eap.codec.ams import DEVICE_PORT, AmsAnswer, AmsHeader, decode_packet
from eap.codec.coe import EntryRequest, ListRequest, ObjectRequest, SdoInfoOpcode
from eap.codec.mailbox import VoeHeader
from eap.codec.soe import COMMAND_CLEAR, COMMAND_START, DataState, Element, Idn, SoeErrorCode
from eap.errors import EapError, TruncatedError
from eap.gateway.error_table import ads_result
from eap.ids import Endpoint, NetId
from eap.runtime.engine_messages import SlaveDescription, no_mailbox
from eap.services.ads.ads_service import answer_request, check_up
from eap.services.ads.master_ads import MasterAds, Send, StateRequests
from eap.services.ads.slave_ethernet import SlaveEthernet
from eap.services.ads.slave_files import SlaveFiles
from eap.services.ads.slave_notifications import SamplingBudget, SlaveNotifications
from eap.services.device.master_values import MasterDictionaryProvider
from eap.services.routing.service import LocalRequest
from eap.services.slaves.access import LocalSlave
from eap.services.slaves.bus_client import BusClient
from eap.services.tasks import TaskSet

COMMAND_ANSWER_S = 3.0
"""Time that one request waits for a procedure command to end."""
EXECUTION_S = 60.0
"""Time limit of a procedure command."""
KEEP_S = 30.0
"""Time to keep the result of a procedure command for a repeated request."""
MAX_COMMANDS = 64
"""Procedure commands that go on or are kept at a time, of all drives."""
_POLL_S = 0.02
_START = COMMAND_START.to_bytes(2, "little")
_CLEAR = COMMAND_CLEAR.to_bytes(2, "little")
_OCTET = 0xFF
_NET_ID_OFFSET = 3
_OTHER_ADDRESS = frozenset((AdsError.TARGET_MACHINE, AdsError.TARGET_PORT))
_PROTOCOLS: dict[int, SiiProtocol] = {
    IndexGroup.SDO: SiiProtocol.COE,
    IndexGroup.OBJECT_LIST: SiiProtocol.COE,
    IndexGroup.OBJECT_DESCRIPTION: SiiProtocol.COE,
    IndexGroup.ENTRY_DESCRIPTION: SiiProtocol.COE,
    IndexGroup.SOE: SiiProtocol.SOE,
    IndexGroup.VOE: SiiProtocol.VOE,
    IndexGroup.EOE: SiiProtocol.EOE,
} | dict.fromkeys(SlaveFiles.groups, SiiProtocol.FOE)
_UNWATCHED = frozenset((SiiProtocol.FOE, SiiProtocol.VOE, SiiProtocol.EOE))
"""Protocols of messages and files, which have no values."""


class SlaveTarget(NamedTuple):
    """A slave, and the client that wants something from it."""

    slave: SlaveDescription
    client: AdsClient
    access: LocalSlave


class SlaveAds:
    """All slaves of a bus port.

    Args:
        bus: With these slaves.
        net_id: Of the bus port.
        states: Takes requests for states.
        send: Sends a notification to a client.
        budget: Limits of notifications.
    """

    def __init__(
        self,
        bus: BusClient,
        net_id: NetId,
        states: StateRequests,
        send: Send,
        budget: SamplingBudget,
    ) -> None:
        self._bus = bus
        self._sampler = AdsClient(Endpoint("", ""), net_id, DEVICE_PORT)
        self._notifications = SlaveNotifications(net_id, self._sample, send, budget, self._name_of)
        self._states = states
        self._files = SlaveFiles()
        self._ethernet = SlaveEthernet(bus)
        self._commands = ProcedureCommands()
        self._forwarder = AoeForwarder(net_id)

    async def perform(
        self, slave: SlaveDescription, client: AdsClient, operation: Operation
    ) -> OperationOutcome:
        """Do one operation; raise AdsRefusedError, or the errors of a SlaveAccess."""
        match operation:
            case ReadState():
                data = states_of(slave.state).encode()
            case ReadDeviceInfo():
                data = _device_info(slave).encode()
            case WriteControl(ads_state):
                data = b""
                self._states.request(slave.station, al_state_for(ads_state))
            case Read(IndexGroup.DEVICE_DATA, offset, length):
                states = DeviceDataSpace(lambda: states_of(slave.state))
                data = states.read(IndexGroup.DEVICE_DATA, offset, length)
            case Read() | Write() | ReadWrite():
                target = SlaveTarget(slave, client, LocalSlave(self._bus, slave, client))
                protocol = _protocol(slave, operation.group)
                if protocol is SiiProtocol.AOE:
                    return await self._forwarder.perform(target, operation)
                data = await self._exchange(protocol, target, operation)
            case AddNotification(group):
                if _PROTOCOLS.get(group) in _UNWATCHED:
                    why = f"no notifications on index group 0x{group:X}: it has no values"
                    raise AdsRefusedError(AdsError.SERVICE, why)
                handle = await self._notifications.add(slave.station, client, operation)
                data = handle.to_bytes(4, "little")
            case _:
                data = b""
                self._notifications.delete(slave.station, client, operation.handle)
        return OperationOutcome(data=data)

    def client_gone(self, endpoint: Endpoint) -> None:
        """End the notifications of a connection that is closed."""
        self._notifications.client_gone(endpoint)

    async def close(self) -> None:
        """End all notifications."""
        await self._notifications.close()

    def _name_of(self, station: int) -> str:
        """Return the name of a slave with that of its bus."""
        slave = self._bus.view.latest.slaves.get(station)
        return f"{self._bus.name}/{station if slave is None else slave.name}"

    async def _sample(self, station: int, place: Read) -> bytes:
        """Read a value for notifications; raise AdsRefusedError or the errors of a SlaveAccess."""
        bus = await self._bus.view.current()
        check_up(self._bus.name, bus)
        slave = bus.slaves.get(station)
        if slave is None:
            raise AdsRefusedError(AdsError.HOST_UNREACHABLE, f"no slave {station} on the bus")
        outcome = await self.perform(slave, self._sampler, place)
        if outcome.result:
            # A slave that answers by AoE may have results of its own.
            is_known = outcome.result in AdsError._value2member_map_
            result = AdsError(outcome.result) if is_known else AdsError.GENERAL
            raise AdsRefusedError(result, outcome.why)
        return outcome.data

    async def _exchange(
        self, protocol: SiiProtocol, target: SlaveTarget, operation: Read | Write | ReadWrite
    ) -> bytes:
        length = 0 if isinstance(operation, Write) else operation.length
        match protocol:
            case SiiProtocol.FOE:
                found = await self._files.perform(
                    target.access, target.slave.station, target.client, operation
                )
            case SiiProtocol.EOE:
                found = await self._ethernet.perform(
                    target.access, target.slave.station, target.client, operation
                )
            case SiiProtocol.VOE:
                found = await _exchange_vendor(target.access, operation)
            case _:
                group, offset = operation.group, operation.offset
                if isinstance(operation, Write) or (
                    isinstance(operation, ReadWrite) and operation.data
                ):
                    await self._write(target, group, offset, operation.data)
                if isinstance(operation, Write):
                    return b""
                found = await self._read(target, group, offset)
        # An ADS client cannot detect a truncated value, so a longer one is an error.
        if len(found) > length:
            why = f"{len(found)} bytes, the client has room for {length}"
            raise AdsRefusedError(AdsError.SIZE, why)
        return found

    async def _read(self, target: SlaveTarget, group: int, offset: int) -> bytes:
        """Return an entry, an object, a list or a description, or elements of an IDN."""
        access, index, low = target.access, offset >> 16, offset & 0xFFFF
        match group:
            case IndexGroup.SOE:
                place = _soe_place(offset)
                elements = Element.DATA_STATE if place.is_command else place.elements
                return await access.read_elements(place.idn, elements, drive=place.drive)
            case IndexGroup.SDO:
                entry = _sdo_place(offset)
                return await access.read_object(
                    index, entry.subindex, complete=bool(entry.is_complete)
                )
            case IndexGroup.OBJECT_LIST:
                return await access.read_info(
                    SdoInfoOpcode.LIST_REQUEST, ListRequest(index).encode()
                )
            case IndexGroup.OBJECT_DESCRIPTION:
                return await access.read_info(
                    SdoInfoOpcode.OBJECT_REQUEST, ObjectRequest(index).encode()
                )
            case IndexGroup.ENTRY_DESCRIPTION:
                request = EntryRequest(index, low & 0xFF, low >> 8).encode()
                return await access.read_info(SdoInfoOpcode.ENTRY_REQUEST, request)
        raise AdsRefusedError(AdsError.INDEX_GROUP)

    async def _write(self, target: SlaveTarget, group: int, offset: int, data: bytes) -> None:
        """Write an entry, an object or an element, or execute a procedure command."""
        access = target.access
        if group == IndexGroup.SDO:
            entry = _sdo_place(offset)
            await access.write_object(
                entry.index, entry.subindex, data, complete=bool(entry.is_complete)
            )
            return
        if group != IndexGroup.SOE:
            raise AdsRefusedError(AdsError.INDEX_GROUP)
        place = _soe_place(offset)
        if not place.is_command:
            await access.write_elements(place.idn, place.elements, data, drive=place.drive)
        elif data in (b"", _START):
            await self._commands.execute(access, target.slave.station, place)
        else:
            raise AdsRefusedError(AdsError.VALUE, "a command is started by 3, or by no data")


class ProcedureCommands:
    """Procedure commands of drives, from their start to their clearing (IEC 61800-7-300).

    Own format: a request is answered BUSY while the command takes longer than an answer may, and
    the same request finds its result.
    """

    def __init__(self) -> None:
        self._tasks: dict[tuple[int, int, int], asyncio.Task[None]] = {}
        self._running = TaskSet("procedure commands")

    async def execute(self, access: LocalSlave, station: int, place: SoeOffset) -> None:
        """Execute a command, or wait for one that is running."""
        key = station, place.drive, place.idn
        task = self._tasks.get(key)
        if task is None:
            if len(self._tasks) >= MAX_COMMANDS:
                raise AdsRefusedError(
                    AdsError.NO_MEMORY, f"{MAX_COMMANDS} procedure commands are running already"
                )
            task = self._running.start_awaited(_execute(access, place))
            self._tasks[key] = task
            task.add_done_callback(lambda task: self._forget_later(key, task))
        await asyncio.wait({task}, timeout=COMMAND_ANSWER_S)
        if not task.done():
            idn = Idn.of(place.idn)
            raise AdsRefusedError(AdsError.BUSY, f"{idn} is being executed: repeat the request")
        self._forget(key, task)
        task.result()

    def _forget_later(self, key: tuple[int, int, int], task: asyncio.Task[None]) -> None:
        if not task.cancelled():
            task.exception()  # the client may never ask again
            asyncio.get_running_loop().call_later(KEEP_S, self._forget, key, task)

    def _forget(self, key: tuple[int, int, int], task: asyncio.Task[None]) -> None:
        if self._tasks.get(key) is task:
            del self._tasks[key]


async def _execute(access: LocalSlave, place: SoeOffset) -> None:
    """Execute a command; between two polls of its state the drive serves other clients."""
    what = f"procedure command {Idn.of(place.idn)} at drive {place.drive}"
    loop = asyncio.get_running_loop()
    await access.write_elements(place.idn, Element.VALUE, _START, drive=place.drive)
    end_s = loop.time() + EXECUTION_S
    state = DataState.BUSY
    while state & DataState.EXECUTING and not state & DataState.ERROR and loop.time() <= end_s:
        await asyncio.sleep(_POLL_S)
        octets = await access.read_elements(place.idn, Element.DATA_STATE, drive=place.drive)
        state = DataState(int.from_bytes(octets[:2], "little") & DataState.FAILED)
    # A command stays active until it is cleared, also after an error (IEC 61800-7-300).
    await access.write_elements(place.idn, Element.VALUE, _CLEAR, drive=place.drive)
    if state & DataState.ERROR:
        raise SoeError(f"{what}: failed", code=SoeErrorCode.GENERAL)
    if state & DataState.EXECUTING:
        raise MailboxTimeoutError(f"{what}: not done after {EXECUTION_S:g} s")


class AoeForwarder:
    """Requests for slaves that have ADS services themselves, passed on by AoE (ETG.1020).

    A slave gets the NetID of its bus port and its station address as its own address before the
    first request, and again when it answers that it has another one: it forgets it in a restart.

    Args:
        net_id: Of the bus port.
    """

    def __init__(self, net_id: NetId) -> None:
        self._net_id = net_id
        self._addressed: set[int] = set()
        self._numbers = count(1)

    async def perform(self, target: SlaveTarget, operation: Operation) -> OperationOutcome:
        """Have the slave do an operation; return its outcome."""
        client, station = target.client, target.slave.station
        source = client.net_id, client.port
        if station not in self._addressed:
            await self._set_address(target)
            self._addressed.add(station)
        outcome = await self._exchange(target, operation, source)
        # The slave has forgotten its AMS address, as after a power cycle.
        if outcome.result in _OTHER_ADDRESS:
            await self._set_address(target)
            outcome = await self._exchange(target, operation, source)
        return outcome

    async def _set_address(self, target: SlaveTarget) -> None:
        """Assign a slave its address; an error of the slave is ignored."""
        write = Write(IndexGroup.ADDRESS, _NET_ID_OFFSET, bytes(self._net_id))
        await self._exchange(target, write, (self._net_id, target.slave.station))

    async def _exchange(
        self, target: SlaveTarget, operation: Operation, source: tuple[NetId, int]
    ) -> OperationOutcome:
        command, body = encode_query(operation)
        # Clients use the same invoke ids, and a late answer is recognised by its own.
        number = next(self._numbers) & 0xFFFF_FFFF
        header = AmsHeader(
            self._net_id, target.slave.station, *source, command, length=len(body), invoke_id=number
        )
        answer, data = decode_packet(await target.access.exchange_ads(header, body))
        return decode_outcome(command, answer.error_code, bytes(data))


def _protocol(slave: SlaveDescription, group: int) -> SiiProtocol:
    """Return the protocol by which a slave serves a group; raise AdsRefusedError for none."""
    protocol = _PROTOCOLS.get(group, SiiProtocol.AOE)
    if not slave.protocols & (protocol | SiiProtocol.AOE):
        if protocol is SiiProtocol.AOE:
            raise AdsRefusedError(AdsError.INDEX_GROUP)
        why = f"slave {slave.station} does not speak {protocol.title}"
        raise AdsRefusedError(AdsError.SERVICE, why)
    # A slave that is missing on the bus: an exchange would only run into its time-out.
    if not slave.state:
        raise AdsRefusedError(AdsError.TIMEOUT, f"slave {slave.station} does not answer")
    if not slave.to_slave:
        raise no_mailbox(slave)
    return protocol if slave.protocols & protocol else SiiProtocol.AOE


async def _exchange_vendor(access: LocalSlave, operation: Read | Write | ReadWrite) -> bytes:
    """Send a message with its VoE header; ReadWrite, own format, returns the one that answers it.

    Ads.h of the TwinCAT SDK names the group, and that a Write is a message to the mailbox.
    """
    if isinstance(operation, Read):
        raise AdsRefusedError(AdsError.SERVICE)
    try:
        VoeHeader.decode(operation.data)
    except TruncatedError as exc:
        raise AdsRefusedError(AdsError.SIZE, str(exc)) from None
    if isinstance(operation, ReadWrite):
        return await access.exchange_vendor(operation.data)
    await access.send_vendor(operation.data)
    return b""


def _sdo_place(offset: int) -> SdoOffset:
    """Take the offset apart; the subindex means nothing with complete access."""
    place = SdoOffset.decode(offset.to_bytes(4, "little"))
    # Beckhoff's slave stack code refuses reserved bits of the offset as well.
    if place.reserved:
        raise AdsRefusedError(AdsError.INDEX_OFFSET)
    return SdoOffset(0, 1, index=place.index) if place.is_complete else place


def _soe_place(offset: int) -> SoeOffset:
    place = SoeOffset.decode(offset.to_bytes(4, "little"))
    if place.reserved:
        raise AdsRefusedError(AdsError.INDEX_OFFSET)
    return place


def _device_info(slave: SlaveDescription) -> AdsDeviceInfo:
    """Name the slave as its bus does; the version is its revision, from the highest byte down."""
    revision = slave.revision
    high, middle = revision >> 24 & _OCTET, revision >> 16 & _OCTET
    return AdsDeviceInfo(high, middle, revision & 0xFFFF, device_name(slave.name))


BUS_REQUEST_S = 4.0
"""Limit for a request from its receipt: routers give up after 4.5 s, clients after 5 s."""
_IN_HEADER = frozenset((AdsError.HOST_UNREACHABLE, AdsError.TARGET_PORT))
"""Errors of the way to a service, which belong into the AMS header."""
_RESULT_SIZE = 4
_MAX_NAMED = 8

Perform: TypeAlias = Callable[[Operation], Awaitable[OperationOutcome]]


class BusService:
    """The services of one bus port.

    Args:
        bus: Behind the port.
        net_id: Of the port.
        release: Of this software, such as ``0.1.0``.
        send: Sends a notification to a client.
        provider: The dictionary of the master.
        budget: Limits of notifications on values of slaves, shared by all buses.

    Attributes:
        ports: AMS ports that it answers for; a port without a slave is refused here.
    """

    def __init__(
        self,
        bus: BusClient,
        net_id: NetId,
        release: str,
        send: Send,
        provider: MasterDictionaryProvider,
        budget: SamplingBudget,
    ) -> None:
        self.ports: Container[int] = range(1, DEVICE_PORT + 1)
        self._name = bus.name
        self._view = bus.view
        states = StateRequests(bus)
        self._master = MasterAds(bus, net_id, release, send, provider, states)
        self._slaves = SlaveAds(bus, net_id, states, send, budget)

    async def answer(self, request: LocalRequest) -> AmsAnswer:
        """Do the operations of a request; return its answer."""
        header = request.header
        client = AdsClient(request.endpoint, header.source, header.source_port)
        limit = _TimeLimit.of(request, self._name)
        try:
            perform = await self._performer(header.target_port, client)
        except AdsRefusedError as exc:
            return AmsAnswer(error_code=exc.result, why=exc.why)
        except EapError as exc:
            return AmsAnswer(error_code=ads_result(exc), why=str(exc))
        perform_in_time = partial(_perform_within, limit, perform)
        answer = await answer_request(header.command, request.body, perform_in_time)
        result = int.from_bytes(answer.data[:_RESULT_SIZE], "little")
        # Routers put errors of the route into the AMS header, and clients look for them there.
        return AmsAnswer(error_code=result, why=answer.why) if result in _IN_HEADER else answer

    async def close(self) -> None:
        """End all notifications: the bus is gone."""
        await self._master.close()
        await self._slaves.close()

    def client_gone(self, endpoint: Endpoint) -> None:
        """Remove the notifications of a closed connection; files stay open for another one."""
        self._master.client_gone(endpoint)
        self._slaves.client_gone(endpoint)

    async def _performer(self, ams_port: int, client: AdsClient) -> Perform:
        """Return the function that does operations for a port; raise AdsRefusedError for no port.

        A slave that cannot be reached is looked for once more before that is answered.
        """
        bus = await self._view.current()
        if ams_port == DEVICE_PORT:
            return lambda operation: self._master.perform(operation, client)
        slave = bus.slaves.get(ams_port)
        if slave is None or not (bus.is_reachable and slave.to_slave):
            bus = await self._view.confirm()
            slave = bus.slaves.get(ams_port)
        if slave is None:
            known = ", ".join(map(str, islice(bus.slaves, _MAX_NAMED))) or "none"
            why = f"{self._name} has no slave {ams_port}"
            raise AdsRefusedError(AdsError.TARGET_PORT, f"{why}; known slaves: {known}")
        found = slave

        async def perform(operation: Operation) -> OperationOutcome:
            # State and name are cached: a client can read them to see why the bus is down.
            if not isinstance(operation, ReadState | ReadDeviceInfo):
                check_up(self._name, bus)
            try:
                return await self._slaves.perform(found, client, operation)
            except (AdsRefusedError, EapError) as exc:
                # The texts of the engine name a slave by its address alone.
                return _error_outcome(exc, f"{self._name}/{found.name}")

        return perform


class _TimeLimit(NamedTuple):
    """End of the time of a request, and the texts for an operation that does not fit into it."""

    request: LocalRequest
    bus: str
    end_s: float
    """Time of the running loop."""
    waited_s: float
    """Behind other requests."""

    @classmethod
    def of(cls, request: LocalRequest, bus: str) -> _TimeLimit:
        """Return the limit of a request, BUS_REQUEST_S behind its receipt."""
        waited_s = (monotonic_ns() - request.queued_ns) / 1e9 if request.queued_ns else 0.0
        end_s = asyncio.get_running_loop().time() + BUS_REQUEST_S - waited_s
        return cls(request, bus, end_s, waited_s)

    def explain(self, *, is_begun: bool) -> str:
        """Return why an operation was not done."""
        port, ahead = self.request.header.target_port, self.request.ahead
        others = "1 other request" if ahead == 1 else f"{ahead} other requests"
        wait = f"waited {self.waited_s:.1f} s behind {others} of this client"
        if is_begun or not ahead:
            late = f"{self.bus}: port {port}: not done within {BUS_REQUEST_S:g} s"
            return f"{late}: {wait}" if ahead else late
        return f"{self.bus}: {wait}: port {port} got no request; send fewer at a time"


async def _perform_within(
    limit: _TimeLimit, perform: Perform, operation: Operation
) -> OperationOutcome:
    """Do an operation, or return why it was not done; at the end of its time, that it was not."""
    if asyncio.get_running_loop().time() >= limit.end_s:
        return OperationOutcome(AdsError.TIMEOUT, why=limit.explain(is_begun=False))
    try:
        async with asyncio.timeout_at(limit.end_s):
            return await perform(operation)
    except TimeoutError:
        return OperationOutcome(AdsError.TIMEOUT, why=limit.explain(is_begun=True))
    except (AdsRefusedError, EapError) as exc:
        return _error_outcome(exc)


def _error_outcome(error: AdsRefusedError | EapError, where: str = "") -> OperationOutcome:
    if isinstance(error, AdsRefusedError):
        result, why = error.result, error.why
    else:
        result, why = ads_result(error), str(error)
    return OperationOutcome(result, why=f"{where}: {why}" if where and why else why)
