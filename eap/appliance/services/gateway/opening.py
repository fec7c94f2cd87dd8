"""The gateways of an appliance, made from what the plant file says of its buses."""

from __future__ import annotations

import platform
from functools import partial

from eap.aoe.spec import RoutingSpec
from eap.appliance.handover import Handover, PortName
from eap.appliance.services.bus_client import BusClient
from eap.appliance.services.gateway.gateway import MailboxGateway, Settings
from eap.appliance.services.gateway.master_session import MasterSession
from eap.appliance.services.gateway.master_values import MasterView
from eap.appliance.services.gateway.slave_link import PortLink
from eap.appliance.services.routing.planned import access_of
from eap.device.eap_content import Identity
from eap.device.master_dictionary import MasterDictionary
from eap.ids import NetId

_OF_REGISTERS = range(0x9000, 0xB000)
"""Objects that show registers of slaves."""


class MasterDesk:
    """The dictionary of the master behind one bus port, and the view that it shows.

    Args:
        client: Asks the engine.
        port: Which bus.
        release: Of this software.

    Attributes:
        dictionary: To be served after :meth:`refresh`.
    """

    def __init__(self, client: BusClient, port: PortName, release: str) -> None:
        self._view = MasterView(client, port)
        identity = Identity(
            device_name=f"EtherCAT master {port.station}/{port.port}",
            hardware_version=platform.machine(),
            software_version=release,
        )
        self.dictionary = MasterDictionary(self._view, identity)

    async def refresh(self, index: int) -> None:
        """See to it that what the object at *index* shows is not old."""
        await self._view.refresh(with_registers=index in _OF_REGISTERS)

    def open_session(self, room: int) -> MasterSession:
        """Begin a client's session with the dictionary."""
        return MasterSession(self.dictionary, room, self.refresh)


def open_gateways(handover: Handover, client: BusClient, release: str) -> dict[str, MailboxGateway]:
    """Return the gateway to the first bus of each station that has one, by station.

    Args:
        handover: The stations and their buses.
        client: Asks the engine for something on them.
        release: Of this software.
    """
    gateways: dict[str, MailboxGateway] = {}
    stations = {station.name: station for station in handover.stations}
    for bus in handover.buses:
        name = bus.owner.station
        if name not in gateways:
            settings = Settings(NetId.parse(handover.port(bus.owner).net_id))
            routing = handover.routing.get(name, RoutingSpec())
            desk = MasterDesk(client, bus.owner, release)
            gateways[name] = MailboxGateway(
                PortLink(client, bus.owner),
                partial(desk.open_session, settings.room),
                access_of(stations[name], routing),
                settings,
            )
    return gateways
