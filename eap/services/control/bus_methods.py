"""Methods of the control protocol for buses, with the state of one connection, and for gateways.

Methods for buses wait for slaves and for turns, and block only the connection that called.  When
the connection ends, its requests are cancelled, and its open conversations are ended at the slaves
too.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from inspect import isawaitable
from typing import TYPE_CHECKING, Any

import msgspec

from devicebus.sim.spec import FaultKind
from devicebus.wire.alstatus import AlState
from eap.codec.mailbox import MailboxType
from eap.control import bus as records
from eap.control.bus import GatewayParameters, GatewayRow
from eap.control.protocol import ErrorCode, of_station
from eap.errors import ControlError, EapError
from eap.pd.spec import PortKind, StationSpec
from eap.runtime.engine_messages import BusReport
from eap.runtime.handover import PortName, SharedSocket, SocketKind
from eap.services.gateway.gateway_transport import GatewayTable
from eap.services.slaves.bus_client import BusClient, MailboxLock
from eap.services.slaves.segment_link import SegmentLink
from eap.services.socket_table import SocketTable
from eap.suggest import suggest

if TYPE_CHECKING:
    from eap.services.gateway.gateway import MailboxGateway


class Buses:
    """The buses of the appliance, for all connections.

    Args:
        stations: Specifications of those that run here, by name.
        clients: One for each bus.
        segments: Take commands, one for each simulated bus.
    """

    def __init__(
        self,
        stations: Mapping[str, StationSpec],
        clients: Mapping[PortName, BusClient],
        segments: Mapping[PortName, SegmentLink],
    ) -> None:
        self._clients = clients
        self._stations = stations
        self._segments = segments

    def find(self, wanted: records.BusParameters) -> BusClient:
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


async def bus_reports(
    clients: Mapping[PortName, BusClient], timeout_s: float
) -> dict[PortName, BusReport]:
    """Return the reports of all buses that the engine describes in time."""
    # A copy: buses may come and go meanwhile.
    asked = dict(clients)
    found: dict[PortName, BusReport] = {}
    answers = await asyncio.gather(
        *(client.describe(timeout_s) for client in asked.values()), return_exceptions=True
    )
    for port, answer in zip(asked, answers, strict=True):
        if isinstance(answer, BusReport):
            found[port] = answer
        elif not isinstance(answer, EapError):
            raise answer
    return found


class _OpenMailbox:
    """A conversation that a connection has open, with its turn."""

    def __init__(
        self, lock: MailboxLock, kind: MailboxType, opened: records.BusOpenParameters
    ) -> None:
        self.lock = lock
        self.kind = kind
        self.opened = opened
        self.idle: asyncio.TimerHandle | None = None


class BusConnection:
    """Use of buses by one client; :meth:`close` when it leaves."""

    def __init__(self, buses: Buses) -> None:
        self._buses = buses
        self._open_mailboxes: dict[int, _OpenMailbox] = {}
        self._last = 0
        self._methods = dict(
            (
                records.BUS_DESCRIBE.served_by(self._describe),
                records.BUS_OPEN.served_by(self._open),
                records.BUS_ASK.served_by(self._exchange),
                records.BUS_CLOSE.served_by(self._close),
                records.BUS_TRANSFER.served_by(self._transfer),
                records.BUS_BRING.served_by(self._set_state),
                records.BUS_FAULT.served_by(self._fault),
                records.BUS_FORGET.served_by(self._forget),
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

    def opened(self, number: int) -> records.BusOpenParameters | None:
        """Return how a conversation was opened, None if it is not open."""
        mailbox = self._open_mailboxes.get(number)
        return mailbox.opened if mailbox is not None else None

    def close(self) -> None:
        """End all open conversations."""
        for number in list(self._open_mailboxes):
            self._abandon(number)

    async def _describe(self, wanted: records.BusDescribeParameters) -> BusReport:
        client = self._buses.find(wanted)
        return await (client.wait_up() if wanted.wait else client.describe())

    async def _open(self, wanted: records.BusOpenParameters) -> records.OpenConversation:
        client = self._buses.find(wanted)
        if len(self._open_mailboxes) >= records.MAX_CONVERSATIONS:
            reason = f"this connection has {records.MAX_CONVERSATIONS} conversations open"
            raise ControlError(f"{reason}, which is the limit", code=ErrorCode.BUSY)
        kind = records.kind_of(wanted.protocol)
        try:
            async with asyncio.timeout(records.TURN_S):
                # The connection is the requester: its conversations queue as those of one client.
                lock = await client.lock_mailbox(wanted.slave, kind, id(self))
        except TimeoutError:
            reason = f"slave {wanted.slave}: its {kind.name} mailbox was busy with other clients"
            raise ControlError(reason, code=ErrorCode.BUSY) from None
        self._last += 1
        self._open_mailboxes[self._last] = _OpenMailbox(lock, kind, wanted)
        self._begin_idle(self._last)
        return records.OpenConversation(self._last)

    async def _exchange(self, wanted: records.BusAskParameters) -> records.MailboxData:
        mailbox = self._of(wanted.conversation)
        request = records.to_request(mailbox.kind, wanted)
        # A slow slave is no idle client: the timer runs between requests only.
        self._end_idle(mailbox)
        try:
            message = await mailbox.lock.exchange(request)
        finally:
            self._begin_idle(wanted.conversation)
        return records.MailboxData(message.data.hex())

    def _close(self, wanted: records.BusCloseParameters) -> records.ClosedConversation:
        self._of(wanted.conversation)
        self._drop(wanted.conversation).lock.close()
        return records.ClosedConversation(wanted.conversation)

    async def _transfer(self, wanted: records.BusTransferParameters) -> records.DatagramReplies:
        client = self._buses.find(wanted)
        replies = await client.transfer([records.to_datagram(row) for row in wanted.datagrams])
        return records.DatagramReplies([records.reply_row(reply) for reply in replies])

    async def _set_state(self, wanted: records.BusBringParameters) -> records.ReachedState:
        await self._buses.find(wanted).bring(wanted.slave, AlState[wanted.state])
        return records.ReachedState(wanted.state)

    async def _fault(self, wanted: records.BusFaultParameters) -> records.Done:
        segment = self._buses.segment(self._buses.find(wanted).port)
        _check_kind(wanted.command)
        try:
            await segment.command(wanted.command)
        except ValueError as exc:
            raise ControlError(str(exc), code=ErrorCode.VALUE) from None
        return records.Done()

    async def _forget(self, wanted: records.BusForgetParameters) -> records.Done:
        await self._buses.find(wanted).forget()
        return records.Done()

    def _of(self, number: int) -> _OpenMailbox:
        try:
            return self._open_mailboxes[number]
        except KeyError:
            raise _unknown(
                f"no conversation {number} is open on this connection; one without"
                f" requests for {records.IDLE_S:.0f} s is ended"
            ) from None

    def _begin_idle(self, number: int) -> None:
        loop = asyncio.get_running_loop()
        self._open_mailboxes[number].idle = loop.call_later(records.IDLE_S, self._abandon, number)

    def _end_idle(self, mailbox: _OpenMailbox) -> None:
        if mailbox.idle is not None:
            mailbox.idle.cancel()

    def _abandon(self, number: int) -> None:
        self._drop(number).lock.abandon()

    def _drop(self, number: int) -> _OpenMailbox:
        mailbox = self._open_mailboxes.pop(number)
        self._end_idle(mailbox)
        return mailbox


def _check_kind(command: Mapping[str, Any]) -> None:
    """Raise ControlError for a kind of fault that there is not."""
    kinds = [kind.value for kind in FaultKind]
    kind = command.get("kind", kinds[0])
    if kind not in kinds:
        reason = f"no fault {kind!r}{suggest(str(kind), kinds)} (one of {', '.join(kinds)})"
        raise ControlError(reason, code=ErrorCode.VALUE)


def _unknown(reason: str) -> ControlError:
    return ControlError(reason, code=ErrorCode.UNKNOWN_NAME)


_OWN = {SocketKind.GATEWAY_UDP: "udp", SocketKind.GATEWAY_TCP: "tcp"}
_SHARED = {SocketKind.UDP: "udp", SocketKind.TCP: "tcp", SocketKind.PACKET: "ethernet"}


class GatewayMethods:
    """Methods that start, stop and report gateways.

    Args:
        sockets: Where they are served.
        gateways: All of them.
    """

    def __init__(self, sockets: SocketTable, gateways: GatewayTable) -> None:
        self._sockets = sockets
        self._table = gateways

    @property
    def _gateways(self) -> Mapping[PortName, MailboxGateway]:
        return self._table.by_port

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the methods by name."""
        return dict(
            (
                records.GATEWAY_START.served_by(self._start),
                records.GATEWAY_STOP.served_by(self._stop),
                records.GATEWAY_STATUS.served_by(self._status),
            )
        )

    def _start(self, wanted: GatewayParameters) -> list[GatewayRow]:
        found = self._find(wanted)
        for owner in found:
            self._gateways[owner].start()
        return self._rows(found)

    async def _stop(self, wanted: GatewayParameters) -> list[GatewayRow]:
        found = self._find(wanted)
        for owner in found:
            await self._gateways[owner].stop()
        return self._rows(found)

    def _status(self, wanted: GatewayParameters) -> list[GatewayRow]:
        return self._rows(self._find(wanted))

    def _find(self, wanted: GatewayParameters) -> list[PortName]:
        names = [station.name for station in self._sockets.stations]
        if wanted.station not in names:
            reason = f"unknown station {wanted.station!r}{suggest(wanted.station, names)}"
            raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
        buses = [owner for owner in self._gateways if owner.station == wanted.station]
        found = [owner for owner in buses if wanted.port in {"", owner.port}]
        if not found:
            known = [owner.port for owner in buses]
            ports = f"its bus ports are {', '.join(known)}" if known else "it has no bus ports"
            which = f"no bus port {wanted.port!r}" if wanted.port else "no gateway"
            reason = f"station {wanted.station} has {which}; {ports}{suggest(wanted.port, known)}"
            raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
        return found

    def _rows(self, owners: list[PortName]) -> list[GatewayRow]:
        return [gateway_row(owner, self._gateways[owner], self._served(owner)) for owner in owners]

    def _served(self, owner: PortName) -> list[str]:
        """Return the sockets behind which a gateway is."""
        first = next(each for each in self._gateways if each.station == owner.station)
        found = []
        for shared in self._sockets.sockets:
            if shared.kind in _OWN and owner in shared.owners:
                found.append(_place(_OWN[shared.kind], shared))
            elif shared.kind in _SHARED and first == owner:
                # Of several stations at a socket, the first that has a gateway.
                stations = [each.station for each in shared.owners]
                known = {each.station for each in self._gateways}
                if next((name for name in stations if name in known), "") == owner.station:
                    found.append(_place(_SHARED[shared.kind], shared))
        return found


def gateway_row(owner: PortName, gateway: MailboxGateway, served: list[str]) -> GatewayRow:
    """Return state, settings and counters of a gateway.

    Args:
        owner: Its bus port.
        gateway: The gateway.
        served: Sockets behind which it is.
    """
    settings = gateway.settings
    transfers = gateway.transfers()
    return GatewayRow(
        station=owner.station,
        port=owner.port,
        served=served,
        state="running" if gateway.is_open else "stopped",
        dropped=gateway.dropped,
        settings=records.GatewaySettings(
            round(settings.answer_s * 1000),
            settings.is_silent,
            settings.limits.in_flight,
            settings.limits.rate,
            settings.limits.clients,
        ),
        clients=[
            records.GatewayClientRow(
                transport=endpoint.transport,
                address=endpoint.connection,
                requests=counts.requests,
                repeated=counts.repeated,
                errors=counts.errors,
                waiting=gateway.tracker.waiting(endpoint),
                transfers=[
                    records.TransferRow(key.address, key.kind.name)
                    for key in transfers
                    if key.endpoint == endpoint
                ],
            )
            for endpoint, counts in gateway.tracker.table().items()
        ],
        slaves=[
            msgspec.convert(
                {**row, "name": settings.names.get(row["address"], "")}, records.MailboxFigures
            )
            for row in gateway.statistics.report()
        ],
    )


def _place(scheme: str, shared: SharedSocket) -> str:
    number = f":{shared.port}" if shared.port else ""
    return f"{scheme}://{shared.address}{number}"
