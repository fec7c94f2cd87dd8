"""Client of the engine for buses: conversations, procedures and states, step by step.

Rule: the engine does single steps only.  Whole transfers, their order and their errors are handled
here, so that the engine never waits for a file or for a client.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable, Sequence
from time import monotonic_ns
from typing import TypeVar

from devicebus.drive import drive_async
from devicebus.errors import BusError, MailboxBusyError
from devicebus.mailbox.conversation import Conversation, MailboxMessage, MailboxRequest
from devicebus.master.access import DatagramReply, DatagramRequest
from devicebus.master.procedure import Procedure, Sleep, Step, StepResult
from devicebus.wire.alstatus import AlState
from eap.appliance.bus_request import (
    BringSlaves,
    BusReport,
    DescribeBus,
    ExchangeDatagrams,
    ForgetFaults,
    UnsolicitedMessage,
)
from eap.appliance.control_bus import BRING_S, PATIENCE_S, TRANSFER_S
from eap.appliance.handover import PortName
from eap.appliance.services.bus.mailbox_queue import MailboxQueues, MailboxTurn
from eap.appliance.services.engine_link import EngineLink
from eap.appliance.services.slaves.bus_view import BusView
from eap.codec.mailbox import MailboxType
from eap.errors import EapError, EngineGoneError

T = TypeVar("T")

DESCRIBE_S = 1.0
_LOOK_S = 0.05
_S = 1_000_000_000


class BusClient:
    """All buses of the appliance, as services use them.

    Args:
        link: To the engine.
        ports: All bus ports in the order that numbers them.

    Attributes:
        views: Cached descriptions of all buses.
    """

    def __init__(self, link: EngineLink, ports: Sequence[PortName]) -> None:
        self.ports = tuple(ports)
        self._link = link
        self._numbers = {port: number for number, port in enumerate(ports)}
        self._queues = MailboxQueues()
        self.views = {port: BusView(link, number) for port, number in self._numbers.items()}

    def listen(self, port: PortName, notify: Callable[[UnsolicitedMessage], None]) -> None:
        """Call *notify* with each message that a slave of a bus sends unasked."""
        number = self._numbers[port]

        def take(message: UnsolicitedMessage) -> None:
            if message.bus == number:
                notify(message)

        self._link.on_unsolicited.append(take)

    async def describe(self, port: PortName, timeout_s: float = DESCRIBE_S) -> BusReport:
        """Return the report of a bus; raises EngineGoneError."""
        bus = self._numbers[port]
        reply = await self._link.request(lambda number: DescribeBus(id=number, bus=bus), timeout_s)
        if reply.report is None:
            raise BusError(f"{_name(port)}: the engine says nothing about it")
        return reply.report

    async def wait_up(self, port: PortName) -> BusReport:
        """Return the report of a bus once it is up.

        Raises:
            BusError: it is not after PATIENCE_S, with the reason.
            EngineGoneError: there is no engine all the while.
        """
        await self._be_up(port)
        return await self.describe(port)

    async def _be_up(self, port: PortName) -> None:
        """Wait until a bus is up; raises as :meth:`wait_up` does."""
        if self.views[port].latest.is_up:
            return
        loop = asyncio.get_running_loop()
        end_s = loop.time() + PATIENCE_S
        while True:
            error: EapError
            try:
                bus = await self.views[port].current()
            except EngineGoneError as exc:
                error = exc
            else:
                if bus.is_up:
                    return
                error = BusError(f"{_name(port)} is not up: {bus.fault or 'it begins'}")
            if loop.time() >= end_s:
                raise error
            await asyncio.sleep(_LOOK_S)

    async def open_turn(
        self,
        port: PortName,
        station: int,
        kind: MailboxType,
        requester: Hashable,
        turn_s: float | None = None,
    ) -> MailboxTurn:
        """Wait for a turn at the mailbox of a slave, no longer than *turn_s* if that is given.

        Raises:
            MailboxBusyError: others had it all the time.
            BusError, EngineGoneError: as :meth:`wait_up` does.
        """
        await self._be_up(port)
        mailbox = port, station, kind
        try:
            async with asyncio.timeout(None if self._queues.is_free(mailbox) else turn_s):
                await self._queues.take(mailbox, requester)
        except TimeoutError:
            raise MailboxBusyError(
                f"slave {station}: the {kind.name} transfers of other clients took {turn_s:g} s"
            ) from None
        bus = self._numbers[port]
        return MailboxTurn(self._link, bus, station, kind, lambda: self._queues.release(mailbox))

    async def converse(
        self,
        port: PortName,
        station: int,
        conversation: Conversation[T],
        requester: Hashable,
        turn_s: float | None = None,
    ) -> T:
        """Drive a conversation with a slave to its end; return its result.

        Raises:
            MailboxBusyError: its turn did not come within *turn_s*.
            BusError: the slave has no mailbox, does not answer, or refuses; as its class says.
            SdoAbortError: it refuses an SDO.
            EngineGoneError: there is no engine, or not the one with which it began.
        """
        turn: MailboxTurn | None = None

        async def exchange(request: MailboxRequest) -> MailboxMessage:
            nonlocal turn
            if turn is None:
                turn = await self.open_turn(port, station, request.type, requester, turn_s)
            return await turn.exchange(request)

        try:
            return await drive_async(conversation, exchange)
        except asyncio.CancelledError:
            if turn is not None:
                turn.abandon()
            raise
        finally:
            if turn is not None:
                turn.close()

    async def run(self, port: PortName, procedure: Procedure[T]) -> T:
        """Run a procedure to its end; return its result or raise what went wrong."""
        await self._be_up(port)

        async def exchange(step: Step) -> StepResult:
            if isinstance(step, Sleep):
                await asyncio.sleep(step.duration_ns / _S)
                return StepResult((), monotonic_ns())
            return StepResult(await self.transfer(port, step), monotonic_ns())

        return await drive_async(procedure, exchange)

    async def transfer(
        self, port: PortName, accesses: Sequence[DatagramRequest]
    ) -> list[DatagramReply]:
        """Send datagrams, none of them logical, and return the reply to each.

        Raises:
            FrameLostError: nothing came back.
            EngineGoneError: there is no engine.
        """
        await self._be_up(port)
        bus = self._numbers[port]
        datagrams = tuple(accesses)
        reply = await self._link.request(
            lambda number: ExchangeDatagrams(id=number, bus=bus, datagrams=datagrams), TRANSFER_S
        )
        return list(reply.replies)

    async def bring(self, port: PortName, station: int, target: AlState) -> None:
        """Bring a slave, or with station 0 all of them, to a state where they are kept then.

        Raises:
            AlStatusError, StateTimeoutError: one refuses, or takes too long.
            BusError: there is no such slave, or several refuse.
            EngineGoneError: there is no engine.
        """
        await self._be_up(port)
        bus = self._numbers[port]
        await self._link.request(
            lambda number: BringSlaves(id=number, bus=bus, station=station, target=target),
            BRING_S,
        )

    async def forget(self, port: PortName) -> None:
        """Have the engine forget the faults of a bus that are over; raises EngineGoneError."""
        bus = self._numbers[port]
        await self._link.request(lambda number: ForgetFaults(id=number, bus=bus), DESCRIBE_S)


def _name(port: PortName) -> str:
    return f"{port.station}/{port.port}"
