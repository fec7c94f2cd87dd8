"""Whether a station can be made of a specification at all: tried in memory, without any network."""

from __future__ import annotations

from eap.ids import InterfaceUri
from eap.net.loopback import LoopbackLines
from eap.pd.image import format_image
from eap.pd.layout import plan_layout
from eap.pd.spec import PortKind, StationSpec
from eap.pd.station import Station


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
