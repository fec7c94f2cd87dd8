from __future__ import annotations

from typing import Any

import pytest

from eap.cli.pd_view import change_line, pd_rows


def change(value: object, **more: object) -> dict[str, Any]:
    return {
        "station": "mixer",
        "variable": "level",
        "value": value,
        "time": "2026-11-21T10:20:30.456+00:00",
        "cycle": 12,
        **more,
    }


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "true"),
        (-3, "-3"),
        (0.6499999761581421, "0.65"),
        ([1.0, 2.5], "[1, 2.5]"),
        (None, "None"),
        ("ab" * 30, "ab" * 24 + "… (60 characters)"),
    ],
)
def test_change_as_a_line(value: object, text: str) -> None:
    assert change_line(change(value)) == f"10:20:30.456  mixer/level = {text}  cycle 12"


@pytest.mark.parametrize(
    ("quality", "text"), [(0, "0"), (25, "2.5 ms"), (65535, "> 6.5 s"), (None, "never received")]
)
def test_quality_of_a_received_variable(quality: int | None, text: str) -> None:
    assert change_line(change(1, quality=quality)).endswith(f"  cycle 12  quality {text}")


def test_change_line_after_skipped_cycles_says_how_many() -> None:
    assert change_line(change(1, skipped=3)).endswith("  cycle 12  (3 skipped)")
    assert change_line(change(1, quality=0, skipped=9)).endswith("  quality 0  (9 skipped)")


def test_variables_of_no_pd_have_a_row_of_their_own() -> None:
    speed, level = (
        {"name": name, "type": "INT", "unit": "", "writer": "engine"} for name in ("speed", "level")
    )
    pds = [{"station": "mixer", "direction": "tx", "name": "state", "variables": [speed]}]
    listed = [{**speed, "comment": ""}, {**level, "comment": "of the tank"}]
    rows = list(pd_rows("mixer", pds, listed))
    rest = {"station": "mixer", "direction": None, "name": None, "variables": [level]}
    assert rows == [*pds, rest]
    assert list(pd_rows("mixer", pds, listed[:1])) == pds
