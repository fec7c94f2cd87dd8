"""Variables that show how a bus is: whether its exchange is good, and where its slaves are."""

from __future__ import annotations

from collections.abc import Sequence

from devicebus.master.master import Master
from eap.pd.image import Image
from eap.pd.spec import BusSlaveSpec

STATE = "state"
WKC_OK = "wkc_ok"


class BusStates:
    """Writes ``PORT.state``, ``PORT.wkc_ok`` and ``PORT.SLAVE.state``, where there are such."""

    def __init__(self, port: str, slaves: Sequence[BusSlaveSpec], image: Image) -> None:
        self._image = image
        self._stations = [slave.station for slave in slaves]
        self._names = [
            f"{port}.{STATE}",
            f"{port}.{WKC_OK}",
            *(f"{port}.{slave.name}.{STATE}" for slave in slaves),
        ]
        self._shown = [-1] * len(self._names)
        self._seen: tuple[Master, int, bool] | None = None

    def show(self, master: Master) -> None:
        """Store what has changed; the caller stands in the engine's writing."""
        cycle = master.cycle
        seen = master, master.changes, cycle is not None and cycle.is_full
        if seen == self._seen:
            return
        self._seen = seen
        units = master.units
        lowest = min([unit.al_state for unit in units.values()], default=0)
        values = [lowest, int(seen[2])]
        values += [units[at].al_state if at in units else 0 for at in self._stations]
        for name, value, shown in zip(self._names, values, self._shown, strict=True):
            if value != shown and name in self._image.places:
                self._image.store(name, bytes((value,)))
        self._shown = values
