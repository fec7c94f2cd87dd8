"""Connections to the stations of a plant on all of its hosts, to show and change what they run.

Stations of this host are reached by their control socket, those of other hosts by ADS, under their
access rules: the service ``configure``.  A host that is not reached, or whose release is too far
from this one, is *away* with the reason, and the others are not.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any, NamedTuple

from msgspec.structs import replace

from eap.closeable import Closeable
from eap.config.load import Plant
from eap.config.plant_sections import HostSection
from eap.control.by_ads import CONFIGURE_METHODS
from eap.control.protocol import HELLO, AnswerT, ErrorCode, Hello, Method, ParametersT
from eap.errors import ConfigError, ControlError
from eap.ids import NetId
from eap.live.ads_connection import AdsConnection, RemoteHost
from eap.ops.plant import (
    ApplianceClient,
    AwayHost,
    PlantLink,
    connect_local,
    link_to,
)
from eap.pd.spec import PortKind
from eap.release import RELEASE, are_neighbours
from eap.runtime.folder import ApplianceInfo
from eap.runtime.plantfile import load_plant


class HostLink(NamedTuple):
    """Connections to the stations of a plant.

    Attributes:
        link: The connections.
        plant: The plant; specifications of stations name files as their hosts have them.
        notes: Remarks about hosts, such as another release.
    """

    link: PlantLink
    plant: Plant
    notes: tuple[str, ...] = ()


class RemoteAppliance(Closeable):
    """Client of the appliance of another host (ApplianceClient).

    Attributes:
        info: Its description, as far as ``hello`` has it.
        hello: Its answer to ``hello``.
    """

    def __init__(self, address: RemoteHost, host: str, runner: asyncio.Runner) -> None:
        self._runner = runner
        self._connection = runner.run(AdsConnection.open(address))
        try:
            self.hello: Hello = HELLO.decode(self._request(HELLO.name, {}))
        except ControlError:
            self.close()
            raise
        self.info = ApplianceInfo(
            plant=self.hello.plant,
            plant_file=self.hello.plant_file,
            stations=self.hello.stations,
            started_at="",
            supervisor=0,
            audit_required=self.hello.audit_required,
            host=host,
        )

    def call(
        self,
        method: Method[ParametersT, AnswerT],
        /,
        *,
        within_s: float = 0,
        **params: Any,
    ) -> AnswerT:
        """Return the answer to *method*; the connection has its own time limit.

        Raises:
            ControlError: the appliance refused, or does not answer.
        """
        del within_s
        try:
            return method.decode(self._request(method.name, params))
        except ControlError as exc:
            hint = ""
            if exc.code == ErrorCode.REFUSED:
                hint = "; the access rules of the station have to allow configure"
            raise ControlError(f"host {self.info.host}: {exc}{hint}", code=exc.code) from None

    def close(self) -> None:
        """Close the connection."""
        self._runner.run(self._connection.close())

    def _request(self, method: str, params: dict[str, Any]) -> Any:
        return self._runner.run(self._connection.request(method, params))


@contextmanager
def link_to_hosts(plant: Plant, file: Path, *, local: bool = False) -> Iterator[HostLink]:
    """Connect to the appliances that run *plant*, described by *file*, for the length of a block.

    Those of other hosts are left out for a *local* link.

    Raises:
        ControlError: no other host is wanted, and none of the stations runs here.
        ConfigError: the file cannot be read as another host has it.
    """
    if local or not plant.hosts:
        with link_to(plant, file) as link:
            yield HostLink(link, plant)
        return
    with ExitStack() as stack:
        runner = stack.enter_context(asyncio.Runner())
        clients: dict[str, ApplianceClient] = {**connect_local(plant, stack)}
        remote: dict[str, RemoteAppliance] = {}
        away: list[AwayHost] = []
        for host in plant.hosts:
            # Stations of another host may run here, as in a trial of the plant on one computer.
            missing = [name for name in host.stations if name not in clients]
            if not missing:
                continue
            found, why = _connect(plant, host, missing, runner, stack)
            remote |= found
            if left := tuple(name for name in missing if name not in found):
                away.append(AwayHost(host.name, left, why or "not running there"))
        clients |= remote
        # In the order of the plant file, whoever answered first.
        order = [station.name for station in plant.stations if station.name in clients]
        plant = _as_installed(plant, file, remote)
        link = PlantLink(
            {name: clients[name] for name in order},
            file,
            (),
            plant.routing,
            audit_required=plant.audit_required,
            remote=remote.keys(),
            away=tuple(away),
        )
        yield HostLink(link, plant, tuple(_notes(remote)))


def _connect(
    plant: Plant, host: HostSection, names: list[str], runner: asyncio.Runner, stack: ExitStack
) -> tuple[dict[str, RemoteAppliance], str]:
    """Return the appliances of a host by station, and the reason why some are missing."""
    found: dict[str, RemoteAppliance] = {}
    why = f"{', '.join(names)}: no port at an IP address that serves AMS"
    for name, address in _addresses(plant, names):
        if name in found:
            continue
        try:
            client = RemoteAppliance(address, host.name, runner)
        except ControlError as exc:
            why = str(exc)
            continue
        stack.enter_context(client)
        if reason := _unfit(client.hello, plant):
            return {}, reason
        found |= {each: client for each in names if each in client.hello.stations}
    return found, "" if found else why


def _addresses(plant: Plant, names: list[str]) -> Iterator[tuple[str, RemoteHost]]:
    """Yield the stations of *names* that serve AMS/TCP, and their addresses."""
    for station in plant.stations:
        for port in station.ports if station.name in names else ():
            uri = port.interface
            if port.kind is not PortKind.EAP or uri.scheme not in {"udp", "tcp"} or not port.ams:
                continue
            # A port on every address names none by which its host is reached.
            if not IPv4Address(uri.host).is_unspecified:
                yield station.name, RemoteHost(uri.host, NetId(station.net_id))
                break


def _unfit(hello: Hello, plant: Plant) -> str:
    """Return why an appliance cannot be changed from here; empty if it can."""
    if hello.plant != plant.name:
        return f"it runs plant {hello.plant}"
    # Records of the configuration are compatible from one release to the next.
    if not are_neighbours(hello.release, RELEASE):
        return (
            f"it runs release {hello.release or 'unknown'}, this eapctl is {RELEASE}: more than"
            " one release apart; upgrade the older one step by step"
        )
    if not CONFIGURE_METHODS.keys() <= set(hello.by_ads):
        return f"its release {hello.release} has no changes by ADS; upgrade it, or run eapctl there"
    return ""


def _notes(remote: dict[str, RemoteAppliance]) -> Iterator[str]:
    """Yield a remark about each host that has another release."""
    releases = {client.info.host: client.hello.release for client in remote.values()}
    for host, release in releases.items():
        if release != RELEASE:
            yield f"host {host} runs release {release}, this eapctl is {RELEASE}"


def _as_installed(plant: Plant, file: Path, remote: dict[str, RemoteAppliance]) -> Plant:
    """Return *plant* with the files of remote stations where their hosts have them."""
    # Paths in the file begin at its folder, which is another one on another host: compared with the
    # paths of here, each such file would be a difference.
    own = file.resolve().parent
    folders = {
        name: Path(client.info.plant_file).parent
        for name, client in remote.items()
        if client.info.plant_file
    }
    for folder in sorted(set(folders.values()) - {own}):
        result = load_plant(file, folder)
        if result.plant is None:
            raise ConfigError("\n".join(map(str, result.findings)))
        there = {name for name, each in folders.items() if each == folder}
        specs = {each.name: each for each in result.plant.stations if each.name in there}
        routing = {name: each for name, each in result.plant.routing.items() if name in there}
        plant = replace(
            plant,
            stations=tuple(specs.get(each.name, each) for each in plant.stations),
            routing={**plant.routing, **routing},
        )
    return plant
