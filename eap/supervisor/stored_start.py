"""Start of the stations as they were configured last, if they can run that way."""

from __future__ import annotations

import logging
from collections.abc import Collection
from pathlib import Path

from msgspec.structs import replace

from eap.errors import ConfigError
from eap.ids import InterfaceUri
from eap.net.loopback import LoopbackLines
from eap.pd.handover import needs_new_start
from eap.pd.image import format_image
from eap.pd.layout import plan_layout
from eap.pd.spec import PortKind, StationSpec
from eap.pd.station import Station
from eap.runtime.folder import ApplianceFolder
from eap.runtime.handover import Handover
from eap.runtime.store import effective
from eap.supervisor.sockets import SharedSockets, UnavailableSocketError

logger = logging.getLogger(__name__)


def with_stored_configuration(handover: Handover, sockets: SharedSockets) -> Handover:
    """Return *handover* with each station as it was configured last, since the plant file or now.

    A configuration whose sockets cannot be opened, or that no engine could ever run, is none of
    this start.
    """
    folder = ApplianceFolder(Path(handover.folder))
    specs = []
    states = {}
    stored = effective(handover.plant, handover.stations, handover.first_state)
    for given, found in zip(handover.stations, stored, strict=True):
        reasons = needs_new_start(given, found.spec)
        if found.spec != given:
            reasons = reasons or find_build_errors(found.spec)
            reasons = reasons or find_missing_slaves(found.spec, folder)
        for reason in reasons:
            logger.warning("station %s: the plant file runs: %s", given.name, reason)
        specs.append(given if reasons else found.spec)
        states[given.name] = found.state
    while True:
        try:
            opened, buses = sockets.fit(specs), sockets.fit_buses(specs)
        except UnavailableSocketError as exc:
            changed = _without_stored(handover, specs, {owner.station for owner in exc.owners})
            if changed == specs:
                raise
            logger.warning("%s: the plant file runs: %s", ", ".join(_names_of(exc)), exc)
            specs = changed
        else:
            return replace(
                handover, stations=tuple(specs), states=states, sockets=opened, buses=buses
            )


def _without_stored(
    handover: Handover, specs: list[StationSpec], names: Collection[str]
) -> list[StationSpec]:
    """Return *specs* with the stations of these *names* as the plant file has them."""
    return [
        given if given.name in names else spec
        for given, spec in zip(handover.stations, specs, strict=True)
    ]


def _names_of(error: UnavailableSocketError) -> list[str]:
    return [f"station {name}" for name in dict.fromkeys(each.station for each in error.owners)]


def find_missing_slaves(spec: StationSpec, folder: ApplianceFolder) -> list[str]:
    """Return why slaves of *spec* cannot be simulated, nothing if all can be.

    The bus file may have been removed since it was applied, and the appliance started again.
    """
    reasons = []
    for port in spec.ports:
        bus = port.bus
        if bus is None or not bus.simulated or folder.segment(bus.simulated).exists():
            continue
        try:
            from eap.runtime.busfile import load_or_raise  # simulated devices, hardly ever needed

            load_or_raise(Path(bus.file))
        except ConfigError as exc:
            reasons.append(f"port {port.name}: {str(exc).splitlines()[0]}")
    return reasons


def find_build_errors(spec: StationSpec) -> list[str]:
    """Return what keeps a station from being built, nothing if it can be.

    A stored configuration may be one that no engine ever ran: services was killed after storing it
    and before the engine rejected it.  The engine would fail with it at every start.
    """
    try:
        layout = plan_layout(spec)
        image = format_image(memoryview(bytearray(layout.size)), layout, 1)
        station = Station(spec, image, lambda: None)
        lines = LoopbackLines()
        for port in spec.ports:
            if port.kind is PortKind.EAP:
                station.connect(port.name, lines.open(InterfaceUri("loop", "trial")))
    except Exception as exc:  # noqa: BLE001  an engine would fail with it, too
        return [f"it cannot be built: {type(exc).__name__}: {exc}"]
    return []
