"""Assembly of mailbox gateways from the specifications of their bus ports."""

from __future__ import annotations

from functools import partial

from eap.ams.access import AccessList
from eap.gateway.request_tracker import ClientLimits
from eap.gateway.requests import AddressMap, GroupAddress, RemoteAddress, SlaveAddress
from eap.ids import NetId
from eap.pd.spec import GatewayAddress, GatewaySpec, PortSpec
from eap.services.device.master_values import MasterDictionaryProvider
from eap.services.gateway.gateway import MailboxGateway, Settings
from eap.services.gateway.sessions import MasterSession
from eap.services.routing.station_router import StationRouter
from eap.services.slaves.bus_client import BusClient
from eap.services.slaves.remote_slave import RemoteSlave
from eap.services.tasks import TaskSet

_MS = 1000


def open_gateway(
    client: BusClient,
    port: PortSpec,
    provider: MasterDictionaryProvider,
    router: StationRouter,
) -> MailboxGateway:
    """Return the gateway to the bus at *port*.

    Args:
        client: Of the bus.
        port: The bus port.
        provider: Dictionary of the master.
        router: Of the station: it knows the access rules, and the way to other buses.
    """
    spec = port.gateway or GatewaySpec()
    settings = _settings(spec, port.net_id, client.name)
    gateway = MailboxGateway(
        client,
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
    return gateway


def follow_settings(
    gateway: MailboxGateway, old: GatewaySpec, port: PortSpec, tasks: TaskSet
) -> None:
    """Apply the settings of *port* to a *gateway* with the *old* ones; *tasks* may stop it."""
    new = port.gateway or GatewaySpec()
    if new == old:
        return
    gateway.change(_settings(new, port.net_id, gateway.settings.name), _addresses(new))
    # A gateway that a command started or stopped stays so, unless this is what changes.
    if new.enabled and not old.enabled:
        gateway.start()
    elif old.enabled and not new.enabled:
        gateway.is_open = False
        tasks.start(gateway.stop())


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
