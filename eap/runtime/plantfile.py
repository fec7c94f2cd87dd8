"""Loading of plant files with the buses that they name, for all programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from eap.config.finding import PlantFinding
from eap.config.index import ExpectedBus
from eap.config.load import PlantResult, load
from eap.errors import ConfigError
from eap.pd.spec import PortKind, StationSpec


def load_plant(path: Path) -> PlantResult:
    """Read, check and complete the plant file at *path* and the bus files that it names."""
    return load(path, _describe)


def require_own_buses(stations: Sequence[StationSpec]) -> None:
    """Check that no two *stations* of this host need one Ethernet interface for a bus.

    A plant file may well name the same interface for stations that run on hosts of their own.

    Raises:
        ConfigError: the bus of one of *stations* is on the interface of another one.
    """
    buses: dict[str, str] = {}
    others: dict[str, str] = {}
    for station in stations:
        for port in station.ports:
            uri = port.interface
            if uri.scheme != "ethernet":
                continue
            label = f"{station.name}/{port.name}"
            is_bus = port.kind is PortKind.BUS
            # EAP ports may share an interface; a bus may share it with nothing.
            taken = buses.get(uri.host) or (others.get(uri.host) if is_bus else None)
            if taken is not None:
                raise ConfigError(
                    f"{uri} is the interface of {taken} and of {label}, expected an interface of"
                    " its own for a bus, or stations that run on different hosts (--station)"
                )
            (buses if is_bus else others)[uri.host] = label


def _describe(path: Path) -> ExpectedBus | tuple[PlantFinding, ...]:
    from eap.runtime.busfile import describe  # simulated devices, when a plant has a bus

    return describe(path)
