"""Client of the engine for one bus: conversations, procedures and states, step by step.

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
from devicebus.master.mailboxes import Unsolicited
from devicebus.master.procedure import Procedure, Sleep, Step, StepReplies
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import DatagramReply, DatagramRequest
from eap.codec.mailbox import MailboxType
from eap.control.bus import BRING_S, PATIENCE_S, TRANSFER_S
from eap.errors import EapError, EngineGoneError
from eap.runtime.bus_request import (
    BringSlaves,
    BusReport,
    DescribeBus,
    ExchangeDatagrams,
    ForgetFaults,
    UnsolicitedMessage,
)
from eap.runtime.handover import PortName
from eap.services.engine_link import EngineLink
from eap.services.slaves.bus_view import BusView
from eap.services.slaves.mailbox_queue import MailboxQueues, MailboxTurn

T = TypeVar("T")

DESCRIBE_S = 1.0
_LOOK_S = 0.05
_S = 1_000_000_000


class BusClient:
    """One bus, as services use it.

    Args:
        link: To the engine.
        number: Of the bus in requests, in the order of the handover.
        port: Its port.

    Attributes:
        port: As given.
        name: ``STATION/PORT``.
        view: Its cached description.
    """

    def __init__(self, link: EngineLink, number: int, port: PortName) -> None:
        self.port = port
        self.name = f"{port.station}/{port.port}"
        self.view = BusView(link, number)
        self._link = link
        self._number = number
        self._queues = MailboxQueues()

    def listen(self, notify: Callable[[Unsolicited], None]) -> None:
        """Call *notify* with each message that a slave sends unasked."""

        def take(message: UnsolicitedMessage) -> None:
            if message.bus == self._number:
                notify(message.message)

        self._link.on_unsolicited.append(take)

    async def describe(self, timeout_s: float = DESCRIBE_S) -> BusReport:
        """Return the report of the bus; raises EngineGoneError."""
        reply = await self._link.request(
            lambda number: DescribeBus(id=number, bus=self._number), timeout_s
        )
        if reply.report is None:
            raise BusError(f"{self.name}: the engine says nothing about it")
        return reply.report

    async def wait_up(self) -> BusReport:
        """Return the report of the bus once it is up.

        Raises:
            BusError: it is not after PATIENCE_S, with the reason.
            EngineGoneError: there is no engine all the while.
        """
        await self._be_up()
        return await self.describe()

    async def _be_up(self) -> None:
        """Wait until the bus is up; raises as :meth:`wait_up` does."""
        if self.view.latest.is_up:
            return
        loop = asyncio.get_running_loop()
        end_s = loop.time() + PATIENCE_S
        while True:
            error: EapError
            try:
                bus = await self.view.current()
            except EngineGoneError as exc:
                error = exc
            else:
                if bus.is_up:
                    return
                error = BusError(f"{self.name} is not up: {bus.fault or 'it begins'}")
            if loop.time() >= end_s:
                raise error
            await asyncio.sleep(_LOOK_S)

    async def open_turn(
        self,
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
        await self._be_up()
        mailbox = station, kind
        try:
            async with asyncio.timeout(None if self._queues.is_free(mailbox) else turn_s):
                await self._queues.take(mailbox, requester)
        except TimeoutError:
            raise MailboxBusyError(
                f"slave {station}: the {kind.name} transfers of other clients took {turn_s:g} s"
            ) from None
        return MailboxTurn(
            self._link, self._number, station, kind, lambda: self._queues.release(mailbox)
        )

    async def converse(
        self,
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
                turn = await self.open_turn(station, request.type, requester, turn_s)
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

    async def run(self, procedure: Procedure[T]) -> T:
        """Run a procedure to its end; return its result or raise what went wrong."""
        await self._be_up()

        async def exchange(step: Step) -> StepReplies:
            if isinstance(step, Sleep):
                await asyncio.sleep(step.duration_ns / _S)
                return StepReplies((), monotonic_ns())
            return StepReplies(await self.transfer(step), monotonic_ns())

        return await drive_async(procedure, exchange)

    async def transfer(self, accesses: Sequence[DatagramRequest]) -> list[DatagramReply]:
        """Send datagrams, none of them logical, and return the reply to each.

        Raises:
            FrameLostError: nothing came back.
            EngineGoneError: there is no engine.
        """
        await self._be_up()
        datagrams = tuple(accesses)
        reply = await self._link.request(
            lambda number: ExchangeDatagrams(id=number, bus=self._number, datagrams=datagrams),
            TRANSFER_S,
        )
        return list(reply.replies)

    async def bring(self, station: int, target: AlState) -> None:
        """Bring a slave, or with station 0 all of them, to a state where they are kept then.

        Raises:
            AlStatusError, StateTimeoutError: one refuses, or takes too long.
            BusError: there is no such slave, or several refuse.
            EngineGoneError: there is no engine.
        """
        await self._be_up()
        await self._link.request(
            lambda number: BringSlaves(id=number, bus=self._number, station=station, target=target),
            BRING_S,
        )

    async def forget(self) -> None:
        """Have the engine forget the faults that are over; raises EngineGoneError."""
        await self._link.request(
            lambda number: ForgetFaults(id=number, bus=self._number), DESCRIBE_S
        )


def open_buses(link: EngineLink, ports: Sequence[PortName]) -> dict[PortName, BusClient]:
    """Return the clients of all buses; *ports* are in the order that numbers them."""
    return {port: BusClient(link, number, port) for number, port in enumerate(ports)}
