"""Methods by which bridges fill sources in controllers, and learn of sources and targets there."""

from __future__ import annotations

from typing import Literal

from eap.codec.datatypes import Plain
from eap.control.protocol import Document, Method, Parameters, Written

FieldKey = Literal["s7", "modbus"]


class FieldPointsParameters(Parameters, frozen=True):
    """``field_points``: of all stations, in the controllers of one bridge."""

    bridge: FieldKey


class FieldPointRow(Document, frozen=True):
    """A source or target in a controller.

    Attributes:
        station: The station.
        variable: Its variable, or a member or element of one.
        kind: Text of the type of that.
        controller: Name of the controller.
        address: Address there.
        type: Type there, empty for that of the variable.
        is_target: True if the controller gets the value.
    """

    station: str
    variable: str
    kind: str
    controller: str
    address: str
    type: str = ""
    is_target: bool = False


class FillParameters(Parameters, frozen=True):
    """``fill``: values that were just read, all of them or none."""

    station: str
    values: dict[str, Plain | None]
    """In plain form; null is NaN."""


FIELD_POINTS = Method("field_points", FieldPointsParameters, list[FieldPointRow])
FILL = Method("fill", FillParameters, Written)
