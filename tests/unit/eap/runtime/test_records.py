from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import msgspec
import pytest

from eap.codec.datatypes import parse
from eap.runtime.attach import to_record

AXIS = parse(
    "S<24/4:a@0 INT,e@2 E<INT:Off=0,On=1>,p@4 P<8/4:x@0 REAL,y@4 REAL>,q@12 INT[2],r@16 P[1]>"
)


class State(IntEnum):
    OFF = 0
    ON = 1


@dataclass
class Point:
    x: float
    y: float


class Axis(msgspec.Struct):
    a: int
    e: State
    p: Point
    q: list[int]
    r: tuple[Point, ...]


@dataclass
class Other:
    b: int


def value() -> Any:
    point = {"x": 1.5, "y": 2.5}
    return AXIS.from_plain({"a": 5, "e": "On", "p": point, "q": [1, 2], "r": [point]})


def test_struct_as_record_with_records_in_it() -> None:
    axis = to_record(value(), Axis)
    assert axis == Axis(5, State.ON, Point(1.5, 2.5), [1, 2], (Point(1.5, 2.5),))
    assert AXIS.encode(axis) == AXIS.encode(value())


def test_members_without_a_field_are_left_out() -> None:
    assert to_record(value()["p"], Point) == Point(1.5, 2.5)


@pytest.mark.parametrize(
    ("given", "kind", "reason"),
    [
        (value(), Other, "Other has a field 'b': expected one of a, e, p, q, r"),
        (5, Point, "5 as Point: expected a struct for a dataclass or msgspec record"),
        (value(), int, "as int: expected a struct for a dataclass"),
    ],
)
def test_what_is_no_record_is_named(given: Any, kind: type, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        to_record(given, kind)
