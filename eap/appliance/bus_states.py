"""Variables that show how a bus is: whether its exchange is good, and where its slaves are."""

from __future__ import annotations

from collections.abc import Sequence

from devicebus.master.bus import Unit
from devicebus.master.master import Master
from eap.pd.image import Image
from eap.pd.spec import BusSlaveSpec

STATE = "state"
WKC_OK = "wkc_ok"


class BusStates:
    """Writes ``PORT.state``, ``PORT.wkc_ok`` and ``PORT.SLAVE.state``, where there are such."""

    def __init__(self, port: str, slaves: Sequence[BusSlaveSpec], image: Image) -> None:
        self._image = image
        self._slaves = [
            (f"{port}.{slave.name}.{STATE}", slave.station)
            for slave in slaves
            if f"{port}.{slave.name}.{STATE}" in image.places
        ]
        names = (f"{port}.{STATE}", f"{port}.{WKC_OK}", *(name for name, _ in self._slaves))
        self._shown: dict[str, int] = {name: -1 for name in names if name in image.places}

    def show(self, master: Master) -> None:
        """Store what has changed; the caller stands in the engine's writing."""
        units = master.units
        states = [_state(unit) for unit in units.values()]
        cycle = master.cycle
        values = [min(states, default=0), int(cycle is not None and cycle.is_full)]
        values += [_state(units.get(station)) for _, station in self._slaves]
        for (name, shown), value in zip(list(self._shown.items()), values, strict=True):
            if value != shown:
                self._shown[name] = value
                self._image.store(name, bytes((value,)))


def _state(unit: Unit | None) -> int:
    return 0 if unit is None or unit.is_lost else int(unit.state)
