"""What the control protocol can be asked for on buses, with what belongs to one connection.

These methods wait for slaves and for turns, and with them only the connection that asked.  When it
ends, what it waits for is cancelled, and its open conversations are ended at the slaves too.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any

import msgspec

from devicebus.sim.spec import FaultKind
from devicebus.wire.alstatus import AlState
from eap.appliance import control_bus
from eap.appliance.bus_request import BusReport
from eap.appliance.control import ErrorCode, of_station, parameters
from eap.appliance.control_bus import BusParameters, kind_of, reply_row, to_access, to_ask
from eap.appliance.handover import PortName
from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.bus.mailbox_queue import MailboxTurn
from eap.appliance.services.bus.segment_link import SegmentLink
from eap.codec.mailbox import MailboxType
from eap.errors import ControlError, EapError
from eap.near import near
from eap.pd.spec import PortKind, StationSpec


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

    def find(self, wanted: BusParameters) -> BusClient:
        """Return the bus that is meant; raise ControlError that names those there are."""
        station = of_station(wanted.station, self._stations)
        buses = [port.name for port in station.ports if port.kind is PortKind.BUS]
        client = self._clients.get(PortName(station.name, wanted.port))
        if client is not None:
            return client
        known = f"its bus ports are {', '.join(buses)}" if buses else "it has no bus ports"
        if any(port.name == wanted.port for port in station.ports):
            raise _unknown(f"port {wanted.port} of station {station.name} is no bus; {known}")
        hint = near(wanted.port, buses)
        raise _unknown(f"station {station.name} has no port {wanted.port!r}; {known}{hint}")

    def segment(self, port: PortName) -> SegmentLink:
        """Return who takes commands for a bus; raise ControlError if it is not simulated."""
        try:
            return self._segments[port]
        except KeyError:
            reason = f"{port.station}/{port.port} is not simulated: nothing can be changed there"
            raise ControlError(reason, code=ErrorCode.REFUSED) from None


class _Held:
    """A conversation that a connection has open, with its turn."""

    def __init__(
        self, turn: MailboxTurn, kind: MailboxType, opened: control_bus.BusOpenParameters
    ) -> None:
        self.turn = turn
        self.kind = kind
        self.opened = opened
        self.idle: asyncio.TimerHandle | None = None


class BusConnection:
    """What one client does on buses; :meth:`close` when it leaves."""

    def __init__(self, buses: Buses) -> None:
        self._buses = buses
        self._held: dict[int, _Held] = {}
        self._last = 0
        self._methods: dict[str, Callable[[dict[str, Any]], Awaitable[Any]]] = {
            "bus_describe": self._describe,
            "bus_open": self._open,
            "bus_ask": self._ask,
            "bus_close": self._close,
            "bus_transfer": self._transfer,
            "bus_bring": self._bring,
            "bus_fault": self._fault,
            "bus_forget": self._forget,
        }

    async def call(self, method: str, params: dict[str, Any]) -> Any:
        """Return the result of one of BUS_METHODS.

        Raises:
            ControlError: the request is wrong, or cannot be served now.
            BusError: the bus or a slave did not do it.
            EngineGoneError: there is no engine.
        """
        return await self._methods[method](params)

    def opened(self, number: int) -> control_bus.BusOpenParameters | None:
        """Return how a conversation was opened, None if it is not open."""
        held = self._held.get(number)
        return held.opened if held is not None else None

    def close(self) -> None:
        """End what is open."""
        for number in list(self._held):
            self._abandon(number)

    async def _describe(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, control_bus.BusDescribeParameters)
        client = self._buses.find(wanted)
        report = await (client.wait_up() if wanted.wait else client.describe())
        return dict(msgspec.to_builtins(report))

    async def _open(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, control_bus.BusOpenParameters)
        client = self._buses.find(wanted)
        if len(self._held) >= control_bus.MAX_CONVERSATIONS:
            reason = f"this connection has {control_bus.MAX_CONVERSATIONS} conversations open"
            raise ControlError(f"{reason}, which is the limit", code=ErrorCode.BUSY)
        kind = kind_of(wanted.protocol)
        try:
            async with asyncio.timeout(control_bus.TURN_S):
                turn = await client.open_turn(wanted.slave, kind, id(self))
        except TimeoutError:
            reason = f"slave {wanted.slave}: others talk {kind.name} with it all the while"
            raise ControlError(reason, code=ErrorCode.BUSY) from None
        self._last += 1
        self._held[self._last] = _Held(turn, kind, wanted)
        self._begin_idle(self._last)
        return {"conversation": self._last}

    async def _ask(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, control_bus.BusAskParameters)
        held = self._of(wanted.conversation)
        request = to_ask(held.kind, wanted)
        self._end_idle(held)
        try:
            message = await held.turn.exchange(request)
        finally:
            self._begin_idle(wanted.conversation)
        return {"data": message.data.hex()}

    async def _close(self, params: dict[str, Any]) -> dict[str, Any]:
        number = parameters(params, control_bus.BusCloseParameters).conversation
        self._of(number)
        self._drop(number).turn.close()
        return {"closed": number}

    async def _transfer(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, control_bus.BusTransferParameters)
        client = self._buses.find(wanted)
        accesses = [to_access(row) for row in wanted.datagrams]
        replies = await client.transfer(accesses)
        return {"replies": [reply_row(reply) for reply in replies]}

    async def _bring(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, control_bus.BusBringParameters)
        client = self._buses.find(wanted)
        await client.bring(wanted.slave, AlState[wanted.state])
        return {"state": wanted.state}

    async def _fault(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, control_bus.BusFaultParameters)
        segment = self._buses.segment(self._buses.find(wanted).port)
        _check_kind(wanted.command)
        try:
            await segment.command(wanted.command)
        except ValueError as exc:
            raise ControlError(str(exc), code=ErrorCode.VALUE) from None
        return {"ok": True}

    async def _forget(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, control_bus.BusForgetParameters)
        client = self._buses.find(wanted)
        await client.forget()
        return {"ok": True}

    def _of(self, number: int) -> _Held:
        try:
            return self._held[number]
        except KeyError:
            raise _unknown(
                f"no conversation {number} is open on this connection; one in which nothing is"
                f" asked for {control_bus.IDLE_S:.0f} s is ended"
            ) from None

    def _begin_idle(self, number: int) -> None:
        loop = asyncio.get_running_loop()
        self._held[number].idle = loop.call_later(control_bus.IDLE_S, self._abandon, number)

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
        reason = f"no fault {kind!r}{near(str(kind), kinds)} (one of {', '.join(kinds)})"
        raise ControlError(reason, code=ErrorCode.VALUE)


def _unknown(reason: str) -> ControlError:
    return ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
