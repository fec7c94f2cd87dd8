"""What of a station can be changed while it runs: all but what the supervisor has opened for it."""

from __future__ import annotations

from collections.abc import Iterator

from msgspec.structs import asdict

from eap.pd.spec import PortSpec, StationSpec

_IN_FRAMES = {"net_id", "eap_sm"}
"""Fields of a port that only say what its frames carry."""
_WHOLE = {"bus", "gateway"}
"""Fields that are too much for a line."""


def needs_new_start(old: StationSpec, new: StationSpec) -> list[str]:
    """Return what differs between the two and cannot be changed by the engine, one line each."""
    found = []
    if old.name != new.name:
        found.append(f"station {old.name} cannot become {new.name}")
    before = {port.name: port for port in old.ports}
    after = {port.name: port for port in new.ports}
    found += [f"port {name} is new" for name in after if name not in before]
    found += [f"port {name} is gone" for name in before if name not in after]
    for name, port in after.items():
        if name in before:
            found += [f"port {name}: {what}" for what in _differences(before[name], port)]
    return [f"{line}: this needs a new start of the appliance" for line in found]


def _differences(old: PortSpec, new: PortSpec) -> Iterator[str]:
    was = asdict(old)
    for field, value in asdict(new).items():
        if field not in _IN_FRAMES and value != was[field]:
            yield (
                f"{field} is another one" if field in _WHOLE else f"{field} {was[field]} -> {value}"
            )
