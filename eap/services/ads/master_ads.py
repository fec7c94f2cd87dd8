"""ADS services of the master of one bus: its states, notifications, and EtherCAT commands.

Own mapping: the state of the master is the highest one that a slave is in, for that is how far its
bus is; TwinCAT's bit 0x10 beside the state of a slave stands for any reason why it is not where it
belongs, and of the bits of its link only that there is none.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Sequence
from time import monotonic_ns, time_ns
from typing import TypeAlias

from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import (
    Command,
    DatagramHeader,
    DatagramReply,
    DatagramRequest,
    WorkingCounter,
    brd,
)
from eap.ads.device import AdsDevice
from eap.ads.io import MasterSpace, SlaveState
from eap.ads.notifications import AdsClient, NotificationTable
from eap.ads.objects import ObjectSpace
from eap.ads.request import AdsRefusedError, Operation, OperationOutcome, ReadWrite, WriteControl
from eap.ads.space import INIT, al_state_for, states_of
from eap.ams.access import group_and_offset
from eap.codec.ads import AdsError, AdsStates, IndexGroup
from eap.codec.adsnotification import AddNotification, to_filetime
from eap.codec.ams import DEVICE_PORT
from eap.errors import EapError, MalformedError, TruncatedError
from eap.gateway.error_table import ads_result
from eap.ids import Endpoint, NetId
from eap.od.model import OdState
from eap.services.ads.ads_service import check_up, device_info
from eap.services.device.master_values import MasterDictionaryProvider
from eap.services.slaves.bus_client import BusClient, BusView
from eap.services.tasks import TaskSet

# States change slowly.
POLL_S = 0.05
"""Shortest time between two looks of notifications at the bus."""
_ERROR = 0x10
_NO_LINK = 0x01
_ALL = 0
_TRIES = 1
"""A client that reads and writes registers itself wants each command sent once."""
_COUNTING = frozenset((Command.APRD, Command.APWR, Command.APRW, Command.BRD))
"""Every slave adds one to the address of these."""

Refresh: TypeAlias = Callable[[], Awaitable[None]]
"""Brings what notifications show up to date; raises EapError."""
Send: TypeAlias = Callable[[Endpoint, bytes], object]
"""Sends a packet to a client, and does not wait for that."""

logger = logging.getLogger(__name__)


class StateRequests:
    """Requests for AL states that are answered at once; the last one for a slave counts.

    Args:
        bus: With these slaves.
    """

    def __init__(self, bus: BusClient) -> None:
        self._bus = bus
        self._tasks: dict[int, asyncio.Task[None]] = {}
        self._running = TaskSet(f"states of {bus.name} by ADS")

    def request(self, station: int, state: int) -> None:
        """Bring a slave, or with station 0 all of them, to a state."""
        # Two requests for one slave would pull it to and fro; the later one wins.
        if (before := self._tasks.pop(station, None)) is not None:
            before.cancel()
        task = self._running.start(self._bring(station, AlState(state)))
        self._tasks[station] = task
        task.add_done_callback(lambda task: self._forget(station, task))

    async def _bring(self, station: int, target: AlState) -> None:
        try:
            await self._bus.bring(station, target)
        except EapError as exc:
            slaves = f"slave {station}" if station else "all slaves"
            logger.warning("%s: %s to %s by ADS: %s", self._bus.name, slaves, target.name, exc)

    def _forget(self, station: int, task: asyncio.Task[None]) -> None:
        if self._tasks.get(station) is task:
            del self._tasks[station]


class MasterStates:
    """States of the master and its slaves, for ``MasterSpace`` and ``AdsDevice``.

    Args:
        view: Of the bus.
        requests: Takes requests for states.
    """

    def __init__(self, view: BusView, requests: StateRequests) -> None:
        self._view = view
        self._requests = requests

    def state(self) -> int:
        """Return the AL state of the master."""
        bus = self._view.latest
        if not bus.is_up:
            return INIT
        return max((slave.state for slave in bus.slaves.values()), default=0) or INIT

    def states(self) -> AdsStates:
        """Return the answer to ReadState."""
        return states_of(self.state())

    def slaves(self) -> Sequence[SlaveState]:
        """Return all slaves, in their order on the bus."""
        return [
            SlaveState(
                slave.station,
                slave.state | (_ERROR if slave.fault else 0),
                0 if slave.state else _NO_LINK,
            )
            for slave in self._view.latest.slaves.values()
        ]

    def request_state(self, state: int) -> None:
        """Bring all slaves to a state, without waiting."""
        self._requests.request(_ALL, state)

    def request_slave_state(self, address: int, state: int) -> None:
        """Bring one slave to a state, without waiting."""
        self._requests.request(address, state)

    def control(self, request: WriteControl) -> None:
        """Act on a WriteControl."""
        self.request_state(al_state_for(request.ads_state))


class MasterAds:
    """The master of a bus as an ADS device.

    Args:
        bus: Of this master.
        net_id: Of the port.
        release: Of this software, such as ``0.1.0``.
        send: Sends a notification to a client.
        provider: The dictionary of the master.
        requests: Takes requests for states.
    """

    def __init__(
        self,
        bus: BusClient,
        net_id: NetId,
        release: str,
        send: Send,
        provider: MasterDictionaryProvider,
        requests: StateRequests,
    ) -> None:
        self._bus = bus
        self._view = bus.view
        self._provider = provider
        self._watched: set[int] = set()
        """Indexes of objects for which there were ever notifications."""
        states = MasterStates(bus.view, requests)
        self._device = AdsDevice(
            device_info(bus.name, release),
            states.states,
            [
                MasterSpace(states),
                ObjectSpace(provider.dictionary, lambda: OdState.OP, ads_result),
            ],
            control=states.control,
        )
        notifications = self._device.notifications
        self._sender = NotificationSender(notifications, self._refresh, send, net_id, DEVICE_PORT)

    async def perform(self, operation: Operation, client: AdsClient) -> OperationOutcome:
        """Do one operation; raise AdsRefusedError or EapError."""
        if isinstance(operation, ReadWrite) and operation.group == IndexGroup.RAW_COMMAND:
            return OperationOutcome(data=await self._send_commands(operation))
        group, offset = group_and_offset(operation)
        is_object = group in ObjectSpace.groups
        if is_object:
            await self._provider.refresh(offset >> 16)
        outcome = self._device.perform(operation, client, monotonic_ns())
        if is_object and isinstance(operation, AddNotification) and not outcome.result:
            self._watched.add(offset >> 16)
        return outcome

    def client_gone(self, endpoint: Endpoint) -> None:
        """End the notifications of a connection that is closed."""
        self._device.notifications.forget(endpoint)

    async def close(self) -> None:
        """End all notifications."""
        await self._sender.close()

    async def _send_commands(self, operation: ReadWrite) -> bytes:
        commands = RawCommands(operation.data)
        check_up(self._bus.name, await self._view.current())
        replies = await self._bus.transfer(commands.accesses())
        answer = commands.encode_answer(replies)
        if len(answer) > operation.length:
            raise AdsRefusedError(AdsError.SIZE)
        return answer

    async def _refresh(self) -> None:
        # An engine that hangs sends no events; a request shows that it is alive.
        await self._view.confirm()
        for index in self._watched:
            await self._provider.refresh(index)


class NotificationSender:
    """Sender of the notifications of one master; polls its bus while there are any.

    Args:
        table: The notifications.
        refresh: Updates the description of the bus.
        send: Reaches the clients.
        net_id: Of the bus port.
        port: AMS port of the master.
    """

    def __init__(
        self, table: NotificationTable, refresh: Refresh, send: Send, net_id: NetId, port: int
    ) -> None:
        self._table = table
        self._refresh = refresh
        self._send = send
        self._net_id = net_id
        self._port = port
        self._task: asyncio.Task[None] | None = None
        self._tasks = TaskSet(f"notifications of {net_id}")
        table.on_add = self._start

    def _start(self) -> None:
        if self._task is None or self._task.done():
            self._task = self._tasks.start(self._run())

    async def close(self) -> None:
        """Send nothing any more."""
        await self._tasks.close()

    async def _run(self) -> None:
        while (due_ns := self._table.next_timeout()) is not None:
            await asyncio.sleep(max(POLL_S, (due_ns - monotonic_ns()) / 1e9))
            if self._table.next_timeout() is None:
                return
            try:
                await self._refresh()
            except EapError as exc:
                logger.debug("notifications of %s delayed: %s", self._net_id, exc)
                continue
            for notice in self._table.handle_cycle(monotonic_ns(), to_filetime(time_ns())):
                self._send(notice.client.endpoint, notice.encode(self._net_id, self._port))


class RawCommands:
    """EtherCAT commands that a client sends to a bus by ADS, as AdsLib does (its ECatAccess.cpp).

    Each is a datagram with its header and its working counter, there and back; several follow each
    other.  The engine takes those that do not disturb the exchange of process data.

    Args:
        data: Of the request.

    Raises:
        AdsRefusedError: SIZE, it ends too early, or VALUE, a command is unknown.
    """

    def __init__(self, data: bytes) -> None:
        self._heads: list[DatagramHeader] = []
        self._octets: list[bytes] = []
        at = 0
        try:
            while at < len(data):
                head = DatagramHeader.decode(data, at)
                start = at + DatagramHeader.SIZE
                at = start + head.length + WorkingCounter.SIZE
                if at > len(data):
                    raise AdsRefusedError(AdsError.SIZE, "a command without a working counter")
                self._heads.append(head)
                self._octets.append(data[start : start + head.length])
        except TruncatedError as exc:
            raise AdsRefusedError(AdsError.SIZE, str(exc)) from None
        except MalformedError as exc:
            raise AdsRefusedError(AdsError.VALUE, str(exc)) from None
        if not self._heads:
            raise AdsRefusedError(AdsError.SIZE, "no command")

    def accesses(self) -> list[DatagramRequest]:
        """Return the datagrams to send, behind one that counts the slaves."""
        return [
            # The working counter of a BRD is the number of slaves, which the answers need.
            brd(0, 1),
            *(
                DatagramRequest(Command(head.command), head.adp, head.ado, octets, _TRIES)
                for head, octets in zip(self._heads, self._octets, strict=True)
            ),
        ]

    def encode_answer(self, replies: list[DatagramReply]) -> bytes:
        """Return the commands as they came back, from the replies to :meth:`accesses`."""
        slaves = replies[0].wkc
        return b"".join(
            _returned_header(head, slaves).encode()
            + reply.data
            + WorkingCounter(reply.wkc).encode()
            for head, reply in zip(self._heads, replies[1:], strict=True)
        )


def _returned_header(head: DatagramHeader, slaves: int) -> DatagramHeader:
    """Return the header as it is behind all slaves."""
    # On a real bus every slave increments the address; clients such as AdsLib count slaves by it.
    adp = head.adp + slaves if head.command in _COUNTING else head.adp
    return DatagramHeader(
        head.command, head.index, adp & 0xFFFF, head.ado, head.length, more=head.more
    )
