"""What is worth a warning in a plant file that is well: stations that tools cannot reach whole.

What routes come to is told by those who load the file.
"""

from __future__ import annotations

from pathlib import Path

from eap.appliance.plantfile import load_plant
from eap.config.finding import Finding
from eap.config.load import LoadResult
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_fill import fill
from eap.device.fault import DeviceFault
from eap.pd.spec import PortKind, StationSpec


def check_plant(path: Path) -> tuple[LoadResult, tuple[Finding, ...]]:
    """Load the plant file at *path*; return that, and its warnings if it is well."""
    result = load_plant(path)
    if result.plant is None:
        return result, ()
    warnings = []
    for number, station in enumerate(result.plant.stations):
        place = f"stations[{number}]"
        line = result.lines.get(place, 0)
        for port, reason in _misfits(station):
            message = (
                f"station {station.name}, port {port}: {reason}; it runs, but cannot be changed"
                " while it does"
            )
            expected = "no more than an object dictionary holds"
            warnings.append(Finding(str(path), line, place, message, expected))
    return result, (*warnings, *result.warnings)


def _misfits(station: StationSpec) -> list[tuple[str, str]]:
    """Return the EAP ports of *station* whose dictionary has no room for all of it, and why."""
    found = []
    for port in station.ports:
        if port.kind is PortKind.EAP:
            try:
                fill(EapDictionary(station, port.name))
            except DeviceFault as exc:
                found.append((port.name, exc.text))
    return found
