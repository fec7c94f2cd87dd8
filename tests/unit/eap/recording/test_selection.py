"""Patterns of variables and ports."""

from __future__ import annotations

import pytest

from eap.config.record_texts import matcher
from eap.errors import ControlError
from eap.pd.layout import plan_layout
from eap.recording.selection import check_patterns, select_variables
from tests.unit.eap.conftest import left

NAMES = ["left/ticks", "left/bus0.a[1]", "left-2/ticks", "right/ticks"]


@pytest.mark.parametrize(
    ("patterns", "expected"),
    [
        ([], NAMES),
        (["left"], ["left/ticks", "left/bus0.a[1]"]),
        (["left*"], ["left/ticks", "left/bus0.a[1]", "left-2/ticks"]),
        (["*/ticks"], ["left/ticks", "left-2/ticks", "right/ticks"]),
        (["left-?/tick?"], ["left-2/ticks"]),
        (["left/bus0.a[1]"], ["left/bus0.a[1]"]),
        (["left/bus0.*", "right"], ["left/bus0.a[1]", "right/ticks"]),
        (["Left"], []),
        (["left/bus0Xa[1]"], []),
    ],
)
def test_patterns_select_names(patterns, expected):
    assert list(filter(matcher(patterns), NAMES)) == expected


def test_variables_are_selected_by_name_or_by_their_pd():
    layout = plan_layout(left())
    assert [each.name for each in select_variables(layout, ["left/state"])] == [
        "ticks",
        "running",
        "setpoint",
        "name",
    ]
    assert [each.name for each in select_variables(layout, ["left/lo*"])] == ["load"]
    assert select_variables(layout, []) == list(layout.variables)
    assert select_variables(layout, ["right"]) == []


def test_pattern_that_selects_nothing_is_refused_with_a_hint():
    check_patterns(["left", "*/ticks"], NAMES, "variable")
    with pytest.raises(
        ControlError, match=r"left/tick: it selects no variable, did you mean left/"
    ):
        check_patterns(["left", "left/tick"], NAMES, "variable")
    with pytest.raises(
        ControlError, match=r"z: it selects no port; stations here: left, left-2, ri"
    ):
        check_patterns(["z"], NAMES, "port")
