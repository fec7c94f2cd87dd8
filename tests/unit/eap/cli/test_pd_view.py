from __future__ import annotations

from typing import Any

import pytest
from msgspec import UNSET

from eap.cli.pd_view import (
    UncarriedVariables,
    ValueChange,
    change_lines,
    listed_pds,
    with_members,
)
from eap.control.protocol import VariableRow
from eap.pd.report import MemberRow, PdRow, PdRowVariable
from tests.support.records import record


def change_line(value: object, **more: Any) -> str:
    time = "2026-11-21T10:20:30.456+00:00"
    change = ValueChange(
        station="mixer", variable="level", value=value, time=time, cycle=12, **more
    )
    (line,) = change_lines([change])
    return line


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "true"),
        (-3, "-3"),
        (0.6499999761581421, "0.65"),
        ([1.0, 2.5], "[1, 2.5]"),
        (None, "None"),
        ("ab" * 30, "ab" * 24 + "… (60 characters)"),
        ({"x": 1.5, "on": True, "t": "a, b"}, "{x: 1.5, on: true, t: 'a, b'}"),
    ],
)
def test_change_as_a_line(value: object, text: str) -> None:
    assert change_line(value) == f"10:20:30.456  mixer/level = {text}  cycle 12"


@pytest.mark.parametrize(
    ("quality", "text"), [(0, "0"), (25, "2.5 ms"), (65535, "> 6.5 s"), (None, "never received")]
)
def test_quality_of_a_received_variable(quality: int | None, text: str) -> None:
    assert change_line(1, quality=quality).endswith(f"  cycle 12  quality {text}")


def test_change_line_has_the_number_of_skipped_cycles() -> None:
    assert change_line(1, skipped=3).endswith("  cycle 12  (3 skipped)")
    assert change_line(1, quality=0, skipped=9).endswith("  quality 0  (9 skipped)")


def test_variables_of_no_pd_have_a_row_of_their_own() -> None:
    speed = {"name": "speed", "type": "INT", "unit": "", "writer": "engine"}
    pds = [record(PdRow, station="mixer", direction="tx", name="state", variables=[speed])]
    listed = [VariableRow(name, "INT", "engine", "", "") for name in ("speed", "level")]
    rest = UncarriedVariables("mixer", None, None, [PdRowVariable("level", "INT", "", "engine")])
    assert list(listed_pds("mixer", pds, listed)) == [*pds, rest]
    assert list(listed_pds("mixer", pds, listed[:1])) == pds


def test_members_of_structs_are_listed_with_their_places() -> None:
    text = "S<8/4:a@0 INT,f@2.1 BIT,on@3 BOOL,p@4 P<4/2:x@0 INT,y@2 INT>>"
    listed = [VariableRow(name, kind, "engine", "", "") for name, kind in
              (("axis", text), ("speed", "INT"))]  # fmt: skip
    (row,) = with_members(list(listed_pds("mixer", [], listed)), listed)
    axis, speed = row.variables
    assert (axis.type, speed.members) == ("S", UNSET)
    assert axis.members == [
        MemberRow("axis.a", "INT", 0, 16),
        MemberRow("axis.f", "BIT1", 17, 1),
        MemberRow("axis.on", "BOOL", 24, 8),
        MemberRow("axis.p", "P", 32, 32),
        MemberRow("axis.p.x", "INT", 32, 16),
        MemberRow("axis.p.y", "INT", 48, 16),
    ]
