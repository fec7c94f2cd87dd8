"""Methods of the control protocol for buses, with the state of one connection.

These methods wait for slaves and for turns, and with them only the connection that called.  When it
ends, its requests are cancelled, and its open conversations are ended at the slaves too.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from inspect import isawaitable
from typing import Any

from devicebus.sim.spec import FaultKind
from devicebus.wire.alstatus import AlState
from eap.codec.mailbox import MailboxType
from eap.control import bus as words
from eap.control.protocol import ErrorCode, of_station
from eap.errors import ControlError, EapError
from eap.pd.spec import PortKind, StationSpec
from eap.runtime.bus_request import BusReport
from eap.runtime.handover import PortName
from eap.services.slaves.bus_client import BusClient
from eap.services.slaves.mailbox_queue import MailboxTurn
from eap.services.slaves.segment_link import SegmentLink
from eap.suggest import suggest


class Buses:
    """The buses of the appliance, for all connections.

    Args:
        stations: Those that run here.
        clients: One for each bus.
        segments: Take commands, one for each simulated bus.
    """

    def __init__(
        self,
        stations: Sequence[StationSpec],
        clients: Mapping[PortName, BusClient],
        segments: Mapping[PortName, SegmentLink],
    ) -> None:
        self._clients = clients
        self._stations = {station.name: station for station in stations}
        self._segments = segments

    async def reports(self, timeout_s: float) -> dict[PortName, BusReport]:
        """Return the reports of all buses that the engine describes in time."""
        found: dict[PortName, BusReport] = {}
        answers = await asyncio.gather(
            *(client.describe(timeout_s) for client in self._clients.values()),
            return_exceptions=True,
        )
        for port, answer in zip(self._clients, answers, strict=True):
            if isinstance(answer, BusReport):
                found[port] = answer
            elif not isinstance(answer, EapError):
                raise answer
        return found

    def find(self, wanted: words.BusParameters) -> BusClient:
        """Return the bus that parameters name; raise ControlError with the names there are."""
        station = of_station(wanted.station, self._stations)
        buses = [port.name for port in station.ports if port.kind is PortKind.BUS]
        client = self._clients.get(PortName(station.name, wanted.port))
        if client is not None:
            return client
        known = f"its bus ports are {', '.join(buses)}" if buses else "it has no bus ports"
        if any(port.name == wanted.port for port in station.ports):
            raise _unknown(f"port {wanted.port} of station {station.name} is no bus; {known}")
        hint = suggest(wanted.port, buses)
        raise _unknown(f"station {station.name} has no port {wanted.port!r}; {known}{hint}")

    def segment(self, port: PortName) -> SegmentLink:
        """Return the link for commands to a bus; raise ControlError if it is not simulated."""
        try:
            return self._segments[port]
        except KeyError:
            reason = f"{port.station}/{port.port} is not simulated: nothing can be changed there"
            raise ControlError(reason, code=ErrorCode.REFUSED) from None


class _Held:
    """A conversation that a connection has open, with its turn."""

    def __init__(
        self, turn: MailboxTurn, kind: MailboxType, opened: words.BusOpenParameters
    ) -> None:
        self.turn = turn
        self.kind = kind
        self.opened = opened
        self.idle: asyncio.TimerHandle | None = None


class BusConnection:
    """Use of buses by one client; :meth:`close` when it leaves."""

    def __init__(self, buses: Buses) -> None:
        self._buses = buses
        self._held: dict[int, _Held] = {}
        self._last = 0
        self._methods = dict(
            (
                words.BUS_DESCRIBE.served_by(self._describe),
                words.BUS_OPEN.served_by(self._open),
                words.BUS_ASK.served_by(self._ask),
                words.BUS_CLOSE.served_by(self._close),
                words.BUS_TRANSFER.served_by(self._transfer),
                words.BUS_BRING.served_by(self._bring),
                words.BUS_FAULT.served_by(self._fault),
                words.BUS_FORGET.served_by(self._forget),
            )
        )

    async def call(self, method: str, params: dict[str, Any]) -> Any:
        """Return the result of one of BUS_METHODS.

        Raises:
            ControlError: the request is wrong, or cannot be served now.
            BusError: the bus or a slave did not do it.
            EngineGoneError: there is no engine.
        """
        result = self._methods[method](params)
        return await result if isawaitable(result) else result

    def opened(self, number: int) -> words.BusOpenParameters | None:
        """Return how a conversation was opened, None if it is not open."""
        held = self._held.get(number)
        return held.opened if held is not None else None

    def close(self) -> None:
        """End what is open."""
        for number in list(self._held):
            self._abandon(number)

    async def _describe(self, wanted: words.BusDescribeParameters) -> BusReport:
        client = self._buses.find(wanted)
        return await (client.wait_up() if wanted.wait else client.describe())

    async def _open(self, wanted: words.BusOpenParameters) -> words.OpenConversation:
        client = self._buses.find(wanted)
        if len(self._held) >= words.MAX_CONVERSATIONS:
            reason = f"this connection has {words.MAX_CONVERSATIONS} conversations open"
            raise ControlError(f"{reason}, which is the limit", code=ErrorCode.BUSY)
        kind = words.kind_of(wanted.protocol)
        try:
            async with asyncio.timeout(words.TURN_S):
                turn = await client.open_turn(wanted.slave, kind, id(self))
        except TimeoutError:
            reason = f"slave {wanted.slave}: others talk {kind.name} with it all the while"
            raise ControlError(reason, code=ErrorCode.BUSY) from None
        self._last += 1
        self._held[self._last] = _Held(turn, kind, wanted)
        self._begin_idle(self._last)
        return words.OpenConversation(self._last)

    async def _ask(self, wanted: words.BusAskParameters) -> words.MailboxData:
        held = self._of(wanted.conversation)
        request = words.to_request(held.kind, wanted)
        self._end_idle(held)
        try:
            message = await held.turn.exchange(request)
        finally:
            self._begin_idle(wanted.conversation)
        return words.MailboxData(message.data.hex())

    def _close(self, wanted: words.BusCloseParameters) -> words.ClosedConversation:
        self._of(wanted.conversation)
        self._drop(wanted.conversation).turn.close()
        return words.ClosedConversation(wanted.conversation)

    async def _transfer(self, wanted: words.BusTransferParameters) -> words.DatagramReplies:
        client = self._buses.find(wanted)
        replies = await client.transfer([words.to_datagram(row) for row in wanted.datagrams])
        return words.DatagramReplies([words.reply_row(reply) for reply in replies])

    async def _bring(self, wanted: words.BusBringParameters) -> words.ReachedState:
        await self._buses.find(wanted).bring(wanted.slave, AlState[wanted.state])
        return words.ReachedState(wanted.state)

    async def _fault(self, wanted: words.BusFaultParameters) -> words.Done:
        segment = self._buses.segment(self._buses.find(wanted).port)
        _check_kind(wanted.command)
        try:
            await segment.command(wanted.command)
        except ValueError as exc:
            raise ControlError(str(exc), code=ErrorCode.VALUE) from None
        return words.Done()

    async def _forget(self, wanted: words.BusForgetParameters) -> words.Done:
        await self._buses.find(wanted).forget()
        return words.Done()

    def _of(self, number: int) -> _Held:
        try:
            return self._held[number]
        except KeyError:
            raise _unknown(
                f"no conversation {number} is open on this connection; one in which nothing is"
                f" asked for {words.IDLE_S:.0f} s is ended"
            ) from None

    def _begin_idle(self, number: int) -> None:
        loop = asyncio.get_running_loop()
        self._held[number].idle = loop.call_later(words.IDLE_S, self._abandon, number)

    def _end_idle(self, held: _Held) -> None:
        if held.idle is not None:
            held.idle.cancel()

    def _abandon(self, number: int) -> None:
        self._drop(number).turn.abandon()

    def _drop(self, number: int) -> _Held:
        held = self._held.pop(number)
        self._end_idle(held)
        return held


def _check_kind(command: Mapping[str, Any]) -> None:
    """Raise ControlError for a kind of fault that there is not."""
    kinds = [kind.value for kind in FaultKind]
    kind = command.get("kind", kinds[0])
    if kind not in kinds:
        reason = f"no fault {kind!r}{suggest(str(kind), kinds)} (one of {', '.join(kinds)})"
        raise ControlError(reason, code=ErrorCode.VALUE)


def _unknown(reason: str) -> ControlError:
    return ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
