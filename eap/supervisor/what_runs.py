"""Specifications that a process of the appliance runs when it starts: as configured last."""

from __future__ import annotations

import logging

from msgspec.structs import replace

from eap.ids import InterfaceUri
from eap.net.loopback import LoopbackLines
from eap.pd.handover import needs_new_start
from eap.pd.image import format_image
from eap.pd.layout import plan_layout
from eap.pd.spec import PortKind, StationSpec
from eap.pd.station import Station
from eap.runtime.handover import Handover
from eap.runtime.store import effective

logger = logging.getLogger(__name__)


def what_runs_now(handover: Handover) -> Handover:
    """Return *handover* with each station as it was configured last, since the plant file or now.

    A configuration that needs other sockets than those that were opened, or that no engine could
    ever run, is none of this start.
    """
    specs = []
    states = {}
    stored = effective(handover.plant, handover.stations, handover.first_state)
    for given, found in zip(handover.stations, stored, strict=True):
        reasons = needs_new_start(given, found.spec)
        if found.spec != given:
            reasons = reasons or why_not_built(found.spec)
        for reason in reasons:
            logger.warning("station %s: the plant file runs: %s", given.name, reason)
        specs.append(given if reasons else found.spec)
        states[given.name] = found.state
    return replace(handover, stations=tuple(specs), states=states)


def why_not_built(spec: StationSpec) -> list[str]:
    """Return what keeps a station from being built, nothing if it can be.

    A configuration may have been kept that no engine ever ran: whoever kept it was killed before
    the engine refused it.  Started with it, the engine would fail again and again.
    """
    try:
        layout = plan_layout(spec)
        image = format_image(memoryview(bytearray(layout.size)), layout, 1)
        station = Station(spec, image, lambda: None)
        lines = LoopbackLines()
        for port in spec.ports:
            if port.kind is PortKind.EAP:
                station.connect(port.name, lines.open(InterfaceUri("loop", "trial")))
    except Exception as exc:  # noqa: BLE001  whatever it is, an engine would fail with it too
        return [f"it cannot be built: {type(exc).__name__}: {exc}"]
    return []
