"""The gateways of an appliance, made from what the plant file says of its buses."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from eap.aoe.spec import RoutingSpec
from eap.appliance.handover import Handover, PortName
from eap.appliance.services.bus_client import BusClient
from eap.appliance.services.gateway.gateway import MailboxGateway, Settings
from eap.appliance.services.gateway.master_desk import MasterDesk
from eap.appliance.services.gateway.slave_link import PortLink
from eap.appliance.services.routing.planned import access_of
from eap.ids import NetId


def open_gateways(
    handover: Handover, client: BusClient, desks: Mapping[PortName, MasterDesk]
) -> dict[str, MailboxGateway]:
    """Return the gateway to the first bus of each station that has one, by station.

    Args:
        handover: The stations and their buses.
        client: Asks the engine for something on them.
        desks: Dictionaries of the masters, one for each bus.
    """
    gateways: dict[str, MailboxGateway] = {}
    stations = {station.name: station for station in handover.stations}
    for bus in handover.buses:
        name = bus.owner.station
        if name not in gateways:
            settings = Settings(NetId.parse(handover.port(bus.owner).net_id))
            routing = handover.routing.get(name, RoutingSpec())
            gateways[name] = MailboxGateway(
                PortLink(client, bus.owner),
                partial(desks[bus.owner].open_session, settings.room),
                access_of(stations[name], routing),
                settings,
            )
    return gateways
