"""Client of the engine for one bus: its description, its mailbox queues, its datagrams and states.

The description is cached.  The engine sends a change before the answer to any request that it
handles after it, so a client that requested a state and got its answer finds that state here. Other
changes come within the engine's pause between two polls of its sockets, 20 ms.

Rule 1: the engine executes single steps only.  Whole transfers, their order and their errors are
handled here, so the engine never waits for a file or a client.
Rule 2: at each mailbox one conversation goes on at a time in each protocol; clients take turns.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from time import monotonic_ns
from types import MappingProxyType
from typing import NamedTuple, TypeVar

from msgspec.structs import replace

from devicebus.errors import BusError, MailboxBusyError
from devicebus.mailbox.conversation import (
    ABORT_MESSAGES,
    Conversation,
    MailboxMessage,
    MailboxRequest,
    drive_async,
)
from devicebus.master.findings import SlaveView, find_silence
from devicebus.master.mailboxes import Unsolicited
from devicebus.master.procedure import Procedure, Sleep, Step, StepReplies
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import DatagramReply, DatagramRequest
from eap.codec.mailbox import MailboxType
from eap.control.bus import BRING_S, BUS_WAIT_UP_S, ENGINE_MARGIN_S, TRANSFER_S
from eap.errors import EapError, EngineGoneError
from eap.runtime.bus_status import report_findings
from eap.runtime.engine_messages import (
    BringSlaves,
    BusChange,
    BusReport,
    DescribeBus,
    EoeReport,
    ExchangeDatagrams,
    ExchangeMailbox,
    ForgetFaults,
    Ping,
    Republish,
    SlaveDescription,
    UnsolicitedMessage,
)
from eap.runtime.handover import PortName
from eap.services.engine_link import EngineLink

ENGINE_PING_S = 1.0


class BusDescription(NamedTuple):
    """A bus without counters and times, which only an explicit request brings."""

    is_up: bool = False
    """True if it has been brought up, wherever its slaves are now."""
    fault: str = "no report from the engine yet"
    slaves: Mapping[int, SlaveDescription] = MappingProxyType({})
    """By station address, in the order of the bus; while it is not up those that are expected."""
    is_silent: bool = False
    """True if no frame comes back, so that nothing is known about any slave."""

    @property
    def is_reachable(self) -> bool:
        """True if frames reach its slaves and come back."""
        return self.is_up and not self.is_silent

    def describe_obstacle(self, name: str) -> str:
        """Return why no slave of the bus *name* can be reached, as ``eapctl bus diag`` says it."""
        if not self.is_up:
            return f"{name} is not up: {self.fault or 'starting'}"
        silence = find_silence([SlaveView(at, each.name) for at, each in self.slaves.items()])
        return f"{name}: {silence.what}; {silence.advice}"


class BusView:
    """The description of one bus.

    Args:
        link: To the engine.
        number: Of the bus in messages.

    Attributes:
        latest: As it was received last; empty from a restart of the engine to its first message.
        on_change: Called after each change.
    """

    def __init__(self, link: EngineLink, number: int) -> None:
        self.latest = BusDescription()
        self.on_change: list[Callable[[], None]] = []
        self._link = link
        self._number = number
        self._is_complete = False
        link.on_change.append(self._take)
        link.on_restart.append(self._forget)

    @property
    def is_current(self) -> bool:
        """True if :meth:`current` returns without waiting."""
        return self._is_complete and self._link.is_alive

    async def current(self) -> BusDescription:
        """Return the description, as a rule without waiting; raise EngineGoneError."""
        # A request goes to the engine only if it has sent nothing for a second, or nothing about
        # this bus: a dead engine says nothing, and must not leave an old state here for long.
        if self.is_current:
            return self.latest
        return await self.confirm()

    async def confirm(self) -> BusDescription:
        """Return the description as the engine has it now; raise EngineGoneError."""
        # For a request that the cached description would refuse: its client may know more, from the
        # process image or from the slave itself, than has come here.
        if self._is_complete:
            await self._link.request(lambda number: Ping(id=number), ENGINE_PING_S)
        else:
            await self._link.request(
                lambda number: Republish(id=number, bus=self._number), ENGINE_PING_S
            )
        if not self._is_complete:
            raise EngineGoneError("no report from the engine about the bus")
        return self.latest

    def close(self) -> None:
        """Receive nothing any more: the bus is gone."""
        self._link.on_change.remove(self._take)
        self._link.on_restart.remove(self._forget)
        self._is_complete = False
        self.latest = BusDescription(fault="the bus was removed from the plant")

    def _take(self, change: BusChange) -> None:
        if change.bus != self._number:
            return
        known = {**self.latest.slaves, **{slave.station: slave for slave in change.slaves}}
        # Without the messages before, which another process has read, some slaves are not known.
        self._is_complete = all(station in known for station in change.stations)
        slaves = {station: known[station] for station in change.stations if self._is_complete}
        self.latest = BusDescription(change.is_up, change.fault, slaves, change.is_silent)
        for notify in self.on_change:
            notify()

    def _forget(self) -> None:
        self.latest = BusDescription()
        self._is_complete = False
        for notify in self.on_change:
            notify()


class MailboxQueues:
    """The queues of all mailboxes.

    A client with many requests does not keep out one with few: behind each turn comes the next
    client, not the next request.
    """

    def __init__(self) -> None:
        self._waiting: dict[Hashable, dict[Hashable, deque[asyncio.Future[None]]]] = {}

    def is_free(self, mailbox: Hashable) -> bool:
        """Return whether a turn begins without waiting."""
        return mailbox not in self._waiting

    async def acquire(self, mailbox: Hashable, client: Hashable) -> None:
        """Wait for a turn, which lasts until :meth:`release`; cancelling it gives up the wait."""
        if self.is_free(mailbox):
            self._waiting[mailbox] = {}
            return
        lock = asyncio.get_running_loop().create_future()
        self._waiting[mailbox].setdefault(client, deque()).append(lock)
        try:
            await lock
        except asyncio.CancelledError:
            if lock.done() and not lock.cancelled():  # it came in the same moment
                self.release(mailbox)
            raise

    def release(self, mailbox: Hashable) -> None:
        """End a turn; the next client has the next one."""
        clients = self._waiting[mailbox]
        while clients:
            client = next(iter(clients))
            waiters = clients.pop(client)
            lock = waiters.popleft()
            # At the end of the queue: behind each request of a client comes the next client.
            if waiters:
                clients[client] = waiters
            # A waiter whose request was cancelled is skipped.
            if not lock.done():
                lock.set_result(None)
                return
        del self._waiting[mailbox]


class MailboxLock:
    """A turn at the mailbox of one slave in one protocol; :meth:`close` ends it."""

    def __init__(
        self,
        link: EngineLink,
        bus: int,
        station: int,
        kind: MailboxType,
        release: Callable[[], None],
    ) -> None:
        self._link = link
        self._bus = bus
        self._station = station
        self._kind = kind
        self._release = release
        self._is_open = True
        self._is_idle = True

    async def exchange(self, request: MailboxRequest) -> MailboxMessage:
        """Do one step of a conversation.

        Raises:
            BusError: as the engine's master says.
            EngineGoneError: there is no engine, or not the one with which it began.
        """
        self._is_idle = False
        # The engine answers at the time-out of the slave itself; this limit is for a dead engine.
        limit_s = (request.delay_ns + request.timeout_ns) / _NS_PER_S + ENGINE_MARGIN_S
        reply = await self._link.request(lambda number: self._step(number, request), limit_s)
        return reply.message or MailboxMessage(self._kind, b"")

    def abandon(self) -> None:
        """Close it in the middle, and have the slave end the transfer that was begun."""
        abort = ABORT_MESSAGES.get(self._kind)
        # Slaves handle one transfer at a time (ETG.1000.6): an abandoned one would block the next.
        if self._is_open and not self._is_idle and abort is not None:
            with suppress(EngineGoneError):
                self._link.send(lambda number: self._step(number, abort))
        self.close()

    def close(self) -> None:
        """Release the mailbox to the next client; harmless when closed."""
        if self._is_open:
            self._is_open = False
            self._release()

    def _step(self, number: int, request: MailboxRequest) -> ExchangeMailbox:
        return ExchangeMailbox(id=number, bus=self._bus, station=self._station, request=request)


T = TypeVar("T")

DESCRIBE_S = 1.0
FAULTS_S = 0.5
"""Less than a router waits for the report of another one."""
_POLL_S = 0.05
_NS_PER_S = 1_000_000_000


class BusClient:
    """One bus, as services use it.

    Args:
        link: To the engine.
        number: Of the bus in requests.
        port: Its port.

    Attributes:
        port: As given.
        name: ``STATION/PORT``.
        view: Its cached description.
        report_eoe: Reports the Ethernet switch of the bus, None without one.
    """

    def __init__(self, link: EngineLink, number: int, port: PortName) -> None:
        self.port = port
        self.name = f"{port.station}/{port.port}"
        self.view = BusView(link, number)
        self.report_eoe: Callable[[], EoeReport] | None = None
        self._link = link
        self._number = number
        self._queues = MailboxQueues()
        self._listeners: list[Callable[[Unsolicited], None]] = []
        link.on_unsolicited.append(self._forward)

    def close(self) -> None:
        """Receive nothing any more: the bus is gone, and the engine refuses requests to it."""
        self._link.on_unsolicited.remove(self._forward)
        self.view.close()

    def listen(self, notify: Callable[[Unsolicited], None]) -> None:
        """Call *notify* with each message that a slave sends unasked."""
        self._listeners.append(notify)

    def _forward(self, message: UnsolicitedMessage) -> None:
        if message.bus == self._number:
            for notify in self._listeners:
                notify(message.message)

    async def describe(self, timeout_s: float = DESCRIBE_S) -> BusReport:
        """Return the report of the bus; raises EngineGoneError."""
        reply = await self._link.request(
            lambda number: DescribeBus(id=number, bus=self._number), timeout_s
        )
        if reply.report is None:
            raise BusError(f"{self.name}: no report from the engine")
        if self.report_eoe is None:
            return reply.report
        return replace(reply.report, eoe=self.report_eoe())

    async def find_faults(self, station: int) -> list[str]:
        """Return the present faults of a slave and of its bus, as ``eapctl bus diag`` says them."""
        try:
            report = await self.describe(FAULTS_S)
        except EapError as exc:
            return [f"{self.name}: {exc}"]
        if not report.is_up:
            return [self.view.latest.describe_obstacle(self.name)]
        return [
            f"{self.name}: {'; '.join(filter(None, (each.what, each.advice)))}"
            for each in report_findings(report)
            if station in each.slaves and not each.is_over
        ]

    async def wait_up(self) -> BusReport:
        """Return the report of the bus once it is up.

        Raises:
            BusError: it is not after BUS_WAIT_UP_S, with the reason.
            EngineGoneError: there is no engine all the while.
        """
        await self._wait_up()
        return await self.describe()

    async def _wait_up(self) -> None:
        """Wait until the bus is up; raises as :meth:`wait_up` does."""
        if self.view.latest.is_up:
            return
        loop = asyncio.get_running_loop()
        end_s = loop.time() + BUS_WAIT_UP_S
        while True:
            error: EapError
            try:
                bus = await self.view.current()
            except EngineGoneError as exc:
                error = exc
            else:
                if bus.is_up:
                    return
                error = BusError(bus.describe_obstacle(self.name))
            if loop.time() >= end_s:
                raise error
            await asyncio.sleep(_POLL_S)

    async def lock_mailbox(
        self,
        station: int,
        kind: MailboxType,
        requester: Hashable,
        lock_s: float | None = None,
    ) -> MailboxLock:
        """Wait for a turn at the mailbox of a slave, no longer than *lock_s* if that is given.

        Raises:
            MailboxBusyError: others had it all the time.
            BusError, EngineGoneError: as :meth:`wait_up` does.
        """
        await self._wait_up()
        mailbox = station, kind
        try:
            # A free mailbox, as mostly, is taken without the price of a time-out.
            async with asyncio.timeout(None if self._queues.is_free(mailbox) else lock_s):
                await self._queues.acquire(mailbox, requester)
        except TimeoutError:
            raise MailboxBusyError(
                f"slave {station}: the {kind.name} transfers of other clients took {lock_s:g} s"
            ) from None
        return MailboxLock(
            self._link, self._number, station, kind, lambda: self._queues.release(mailbox)
        )

    async def converse(
        self,
        station: int,
        conversation: Conversation[T],
        requester: Hashable,
        lock_s: float | None = None,
    ) -> T:
        """Drive a conversation with a slave to its end; return its result.

        Raises:
            MailboxBusyError: its turn did not come within *lock_s*.
            BusError: the slave has no mailbox, does not answer, or refuses; as its class says.
            SdoAbortError: it refuses an SDO.
            EngineGoneError: there is no engine, or not the one with which it began.
        """
        lock: MailboxLock | None = None

        async def exchange(request: MailboxRequest) -> MailboxMessage:
            nonlocal lock
            if lock is None:
                lock = await self.lock_mailbox(station, request.type, requester, lock_s)
            return await lock.exchange(request)

        try:
            return await drive_async(conversation, exchange)
        except asyncio.CancelledError:
            if lock is not None:
                lock.abandon()
            raise
        finally:
            if lock is not None:
                lock.close()

    async def run(self, procedure: Procedure[T]) -> T:
        """Run a procedure to its end; return its result or raise its error."""
        await self._wait_up()

        async def exchange(step: Step) -> StepReplies:
            if isinstance(step, Sleep):
                await asyncio.sleep(step.duration_ns / _NS_PER_S)
                return StepReplies((), monotonic_ns())
            return StepReplies(await self.transfer(step), monotonic_ns())

        return await drive_async(procedure, exchange)

    async def transfer(self, accesses: Sequence[DatagramRequest]) -> list[DatagramReply]:
        """Send datagrams, none of them logical, and return the reply to each.

        Raises:
            FrameLostError: nothing came back.
            EngineGoneError: there is no engine.
        """
        await self._wait_up()
        datagrams = tuple(accesses)
        reply = await self._link.request(
            lambda number: ExchangeDatagrams(id=number, bus=self._number, datagrams=datagrams),
            TRANSFER_S,
        )
        return list(reply.replies)

    async def bring(self, station: int, target: AlState) -> None:
        """Bring a slave, or with station 0 all of them, to a state, and keep them there.

        Raises:
            AlStatusError, StateTimeoutError: one refuses, or takes too long.
            BusError: there is no such slave, or several refuse.
            EngineGoneError: there is no engine.
        """
        await self._wait_up()
        await self._link.request(
            lambda number: BringSlaves(id=number, bus=self._number, station=station, target=target),
            BRING_S,
        )

    async def forget(self) -> None:
        """Have the engine forget the faults that are over; raises EngineGoneError."""
        await self._link.request(
            lambda number: ForgetFaults(id=number, bus=self._number), DESCRIBE_S
        )
