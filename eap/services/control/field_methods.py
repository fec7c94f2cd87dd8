"""Methods of bridges to controllers: their sources and targets, and values that they have read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from eap.codec import datatypes
from eap.codec.datatypes import find_variable
from eap.control import field as control
from eap.control.protocol import ErrorCode, Written, of_station
from eap.errors import ControlError
from eap.pd.spec import (
    FieldSource,
    ModbusSource,
    ModbusTarget,
    S7Source,
    S7Target,
    StationSpec,
)
from eap.services.device.field_player import FieldPlayer

_KINDS: dict[str, tuple[type, ...]] = {
    "s7": (S7Source, S7Target),
    "modbus": (ModbusSource, ModbusTarget),
}


class FieldMethods:
    """Methods of bridges.

    Args:
        players: Sources in controllers, by station.
    """

    def __init__(self, players: Mapping[str, FieldPlayer]) -> None:
        self._players = players

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the methods by name."""
        return dict(
            (
                control.FIELD_POINTS.served_by(self._field_points),
                control.FILL.served_by(self._fill),
            )
        )

    def _field_points(self, wanted: control.FieldPointsParameters) -> list[control.FieldPointRow]:
        kinds = _KINDS[wanted.bridge]
        return [row for each in self._players.values() for row in _rows(each.station, kinds)]

    def _fill(self, wanted: control.FillParameters) -> Written:
        player = of_station(wanted.station, self._players)
        if unknown := player.unknown(wanted.values):
            reason = f"station {wanted.station}: {unknown[0]} has no source in a controller"
            raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
        try:
            player.fill(wanted.values)
        except ValueError as exc:
            raise ControlError(str(exc), code=ErrorCode.VALUE) from None
        return Written(len(wanted.values))


def _rows(station: StationSpec, kinds: tuple[type, ...]) -> Iterator[control.FieldPointRow]:
    types = {each.name: datatypes.parse(each.type) for each in station.variables}
    sources = (each for each in station.sources if isinstance(each, FieldSource))
    for each in (*sources, *station.targets):
        if not isinstance(each, kinds):
            continue
        found = find_variable(each.variable, types.get)
        if found is None:  # of a bus that is not described any more
            continue
        yield control.FieldPointRow(
            station.name,
            each.variable,
            found[1].kind.text,
            each.controller,
            each.address,
            each.type,
            isinstance(each, S7Target | ModbusTarget),
        )
