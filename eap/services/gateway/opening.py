"""Assembly of the gateways of an appliance from the plant file."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from eap.ams.access import AccessList
from eap.gateway.request_tracker import ClientLimits
from eap.gateway.requests import AddressMap, GroupAddress, RemoteAddress, SlaveAddress
from eap.ids import NetId
from eap.pd.spec import GatewayAddress, GatewaySpec, StationSpec
from eap.runtime.handover import Handover, PortName
from eap.services.device.master_values import MasterDictionaryProvider
from eap.services.gateway.gateway import MailboxGateway, Settings
from eap.services.gateway.sessions import MasterSession
from eap.services.routing.station_router import StationRouter
from eap.services.slaves.bus_client import BusClient
from eap.services.slaves.remote_slave import RemoteSlave
from eap.services.tasks import TaskSet

_MS = 1000


def open_dictionaries(
    handover: Handover, clients: Mapping[PortName, BusClient], release: str
) -> dict[PortName, MasterDictionaryProvider]:
    """Return the dictionary of the master behind each bus port.

    Args:
        handover: The buses.
        clients: Of the buses.
        release: Of this software.
    """
    providers = {}
    for bus in handover.buses:
        spec = _gateway_of(handover, bus.owner)
        providers[bus.owner] = MasterDictionaryProvider(
            clients[bus.owner], release, full=spec.full, padded=spec.padded
        )
    return providers


def open_gateways(
    handover: Handover,
    clients: Mapping[PortName, BusClient],
    providers: Mapping[PortName, MasterDictionaryProvider],
    routers: Mapping[str, StationRouter],
) -> dict[PortName, MailboxGateway]:
    """Return the gateway to each bus, in their order.

    Args:
        handover: The stations and their buses.
        clients: Of the buses.
        providers: Dictionaries of the masters, one for each bus.
        routers: Of the stations: they know the access rules, and the way to other buses.
    """
    gateways = {}
    for bus in handover.buses:
        spec, router = _gateway_of(handover, bus.owner), routers[bus.owner.station]
        provider = providers[bus.owner]
        settings = _settings(spec, handover.port(bus.owner).net_id, clients[bus.owner].name)
        gateway = MailboxGateway(
            clients[bus.owner],
            partial(
                MasterSession,
                provider.dictionary,
                settings.max_size,
                provider.refresh,
                provider.is_fresh,
            ),
            partial(_access_of, router),
            settings,
            _addresses(spec),
            partial(_open_remote, router),
        )
        # A disabled gateway exists all the same, so that it can be started at run time.
        gateway.is_open = spec.enabled
        gateways[bus.owner] = gateway
    return gateways


class GatewayFollower:
    """Keeps the gateways of a station as its specification has them, while it runs.

    Args:
        spec: That the gateways were opened with.
        gateways: By bus port.
    """

    def __init__(self, spec: StationSpec, gateways: Mapping[str, MailboxGateway]) -> None:
        self._gateways = gateways
        self._specs = {port.name: port.gateway or GatewaySpec() for port in spec.ports}
        self._tasks = TaskSet(f"gateways of station {spec.name}")

    def change(self, spec: StationSpec) -> None:
        """Apply another specification of the station."""
        for port in spec.ports:
            gateway = self._gateways.get(port.name)
            before, becomes = self._specs[port.name], port.gateway or GatewaySpec()
            if gateway is None or before == becomes:
                continue
            self._specs[port.name] = becomes
            settings = _settings(becomes, port.net_id, gateway.settings.name)
            gateway.change(settings, _addresses(becomes))
            # A gateway that a command started or stopped stays so, unless this is what changes.
            if becomes.enabled and not before.enabled:
                gateway.start()
            elif before.enabled and not becomes.enabled:
                gateway.is_open = False
                self._tasks.start(gateway.stop())


def _settings(spec: GatewaySpec, net_id: NetId, name: str) -> Settings:
    return Settings(
        net_id,
        answer_s=spec.answer_ms / _MS,
        is_silent=spec.silent,
        limits=ClientLimits(spec.in_flight, spec.rate, spec.clients),
        name=name,
        names={each.address: each.name for each in spec.addresses if each.name},
    )


def _addresses(spec: GatewaySpec) -> AddressMap:
    return AddressMap({each.address: _destination(each) for each in spec.addresses})


def _gateway_of(handover: Handover, owner: PortName) -> GatewaySpec:
    return handover.port(owner).gateway or GatewaySpec()


def _access_of(router: StationRouter) -> AccessList:
    return router.access


def _open_remote(router: StationRouter, slave: RemoteAddress, answer_s: float) -> RemoteSlave:
    return RemoteSlave(partial(router.request, slave.net_id), slave.port, answer_s)


def _destination(address: GatewayAddress) -> SlaveAddress | RemoteAddress | GroupAddress:
    if address.members:
        return GroupAddress(address.members)
    if address.net_id:
        return RemoteAddress(NetId.parse(address.net_id), address.port)
    return SlaveAddress(address.station)
