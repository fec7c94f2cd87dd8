"""Changes as lines."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from eap.cli.change import change_text, plan_lines
from eap.control.device import ObjectChange
from eap.device.rollout import Step
from eap.ops.plant import PlanReport, StationPlan
from tests.support.fakeappliance import station


def change(kind, old="", new="", subindex=0, unit=""):
    return ObjectChange(
        port="eap0", index=0x6003, subindex=subindex, name="Tx variable 3 (speed)", change=kind,
        old=old, new=new, unit=unit,
    )  # fmt: skip


def shown(plans, order):
    return list(plan_lines(PlanReport.of(plans, order, ()), ""))


@pytest.mark.parametrize(
    ("given", "line"),
    [
        (change("added"), "+ 0x6003:00 Tx variable 3 (speed)"),
        (change("added", new="REAL", subindex=4), "+ 0x6003:04 Tx variable 3 (speed)  REAL"),
        (change("removed", "10"), "- 0x6003:00 Tx variable 3 (speed)"),
        (change("changed", "", "bar", 6), '~ 0x6003:06 Tx variable 3 (speed)  "" -> bar'),
        (change("changed", "1", "2", 7, "us"), "~ 0x6003:07 Tx variable 3 (speed)  1 -> 2 us"),
        (change("changed", "1", "2", 16), "~ 0x6003:10 Tx variable 3 (speed)  1 -> 2"),
    ],
)
def test_signs(given, line):
    assert change_text(given, given.name) == line


def test_all_kinds_of_differences():
    plans = [
        StationPlan("mixer", [change("added"), change("removed")], ["link a to b: added"], []),
        StationPlan("oven", [], [], []),
        StationPlan("saw", [change("changed", "1", "2")], [], []),
    ]
    order = [Step("saw", station("saw"), "takes both"), Step("mixer", station("mixer"), "switches")]
    assert shown(plans, order) == [
        "mixer",
        "  + 0x6003:00 Tx variable 3 (speed)",
        "  - 0x6003:00 Tx variable 3 (speed)",
        "  * link a to b: added",
        "saw",
        "  ~ 0x6003:00 Tx variable 3 (speed)  1 -> 2",
        "2 stations of 3 to change (1 added, 1 removed, 1 changed), 1 unchanged",
        "'eapctl apply' takes these steps:",
        "  1. saw takes both",
        "  2. mixer switches",
    ]


def test_refusals():
    plans = [StationPlan("mixer", [], [], ["port eap1 would be new"])]
    assert shown(plans, []) == [
        "mixer",
        "  ! port eap1 would be new",
        "1 station of 1 to change",
        "cannot be applied: mixer refused",
    ]


def test_several_ports():
    changes = [change("added"), replace(change("added"), port="eap1")]
    lines = shown([StationPlan("mixer", changes, [], [])], [])
    assert lines[1:3] == [
        "  + 0x6003:00 eap0: Tx variable 3 (speed)",
        "  + 0x6003:00 eap1: Tx variable 3 (speed)",
    ]
