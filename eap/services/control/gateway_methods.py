"""Methods of the control protocol about mailbox gateways."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import msgspec

from eap.control import gateway as words
from eap.control.gateway import GatewayParameters, GatewayRow
from eap.control.protocol import ErrorCode
from eap.errors import ControlError
from eap.runtime.handover import Handover, PortName, SharedSocket, SocketKind
from eap.suggest import suggest

if TYPE_CHECKING:
    from eap.services.gateway.gateway import MailboxGateway

_OWN = {SocketKind.GATEWAY_UDP: "udp", SocketKind.GATEWAY_TCP: "tcp"}
_SHARED = {SocketKind.UDP: "udp", SocketKind.TCP: "tcp", SocketKind.PACKET: "ethernet"}


class GatewayMethods:
    """Starts and stops gateways, and tells what they do.

    Args:
        handover: Where they are served.
        gateways: All of them, in the order of the buses.
    """

    def __init__(self, handover: Handover, gateways: Mapping[PortName, MailboxGateway]) -> None:
        self._handover = handover
        self._gateways = gateways

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the methods by name."""
        return dict(
            (
                words.GATEWAY_START.served_by(self._start),
                words.GATEWAY_STOP.served_by(self._stop),
                words.GATEWAY_STATUS.served_by(self._status),
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
        names = [station.name for station in self._handover.stations]
        if wanted.station not in names:
            reason = f"no station {wanted.station!r} here{suggest(wanted.station, names)}"
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
        for shared in self._handover.sockets:
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
        turned_away=gateway.turned_away,
        settings=words.GatewaySettings(
            round(settings.answer_s * 1000),
            settings.is_silent,
            settings.limits.in_flight,
            settings.limits.rate,
            settings.limits.clients,
        ),
        clients=[
            words.GatewayClientRow(
                transport=endpoint.transport,
                address=endpoint.connection,
                requests=counts.requests,
                repeated=counts.repeated,
                errors=counts.errors,
                waiting=gateway.tracker.waiting(endpoint),
                transfers=[
                    words.TransferRow(key.address, key.kind.name)
                    for key in transfers
                    if key.endpoint == endpoint
                ],
            )
            for endpoint, counts in gateway.tracker.table().items()
        ],
        slaves=msgspec.convert(gateway.statistics.report(), list[words.MailboxFigures]),
    )


def _place(scheme: str, shared: SharedSocket) -> str:
    number = f":{shared.port}" if shared.port else ""
    return f"{scheme}://{shared.address}{number}"
