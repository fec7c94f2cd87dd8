"""Part of a plant that an appliance runs: the stations of its host, or those that are named."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from pathlib import Path

from msgspec.structs import replace

from eap.config.hosts import find_host
from eap.config.load import Plant
from eap.config.plant_sections import HostSection
from eap.errors import ConfigError
from eap.net.interface import own_addresses
from eap.pd.spec import StationSpec
from eap.runtime.plantfile import load_plant
from eap.suggest import suggest


def load_part(plant_file: Path, stations: Sequence[str], host: str) -> tuple[Plant, str]:
    """Return the part of the plant in *plant_file* that runs here, and the name of this host.

    Args:
        plant_file: Path of the file.
        stations: Names of the wanted stations; empty for all, of one host if the plant has hosts.
        host: Name of this host; empty to find it by the names and addresses of this computer.

    Returns:
        The plant with the chosen stations; the name is empty if no host was looked for.

    Raises:
        ConfigError: the file is no plant, or has no such station or host.
    """
    plant = _load(plant_file)
    own = _own_host(plant, stations, host)
    if own is not None:
        plant = plant.on_host(own)
    chosen = _choose(plant, stations, own)
    return replace(plant, stations=chosen), "" if own is None else own.name


def _load(plant_file: Path) -> Plant:
    result = load_plant(plant_file)
    if result.plant is None:
        raise ConfigError("\n".join(str(finding) for finding in result.findings))
    return result.plant


def _own_host(plant: Plant, stations: Sequence[str], wanted: str) -> HostSection | None:
    """Return the host that this computer is; None if the plant has one, or stations are named."""
    if not plant.hosts:
        if wanted:
            raise ConfigError(f"plant {plant.name} has no hosts: run it without --host {wanted}")
        return None
    if stations and not wanted:
        return None
    names = dict.fromkeys((socket.gethostname(), socket.gethostname().partition(".")[0]))
    addresses = [address for _, address in own_addresses()]
    return find_host(plant.name, plant.hosts, wanted, [*names], addresses)


def _choose(
    plant: Plant, wanted: Sequence[str], host: HostSection | None
) -> tuple[StationSpec, ...]:
    known = [station.name for station in plant.stations]
    for name in wanted:
        if name not in known:
            for other in plant.hosts:
                if host is not None and name in other.stations:
                    reason = f"station {name} runs on host {other.name}, this is host {host.name}"
                    raise ConfigError(reason)
            hint = suggest(name, known) or f": it has {', '.join(known)}"
            raise ConfigError(f"plant {plant.name} has no station {name!r}{hint}")
    return tuple(s for s in plant.stations if not wanted or s.name in wanted)
