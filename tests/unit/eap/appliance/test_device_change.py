"""Plans of other configurations, and what fills dictionaries."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from eap.appliance.configuration import Configuration
from eap.appliance.device_change import (
    dump_all,
    eap_ports,
    fill_all,
    make_plan,
    plan_rollback,
)
from eap.device.eap_dictionary import EapDictionary
from eap.device.stored import dump
from eap.pd.spec import (
    CounterSource,
    PortKind,
    PortSpec,
    RxAlternateSpec,
    TakenVariableSpec,
)


@pytest.fixture
def spec(stations):
    bus = PortSpec("bus0", PortKind.BUS, "sim://x.yaml", "1.2.3.4.9.1")
    return replace(stations[0], ports=(*stations[0].ports, bus))


@pytest.fixture
def dictionaries(spec):
    made = {"eap0": EapDictionary(spec, "eap0")}
    fill_all(made, {})
    return made


def test_dictionaries_are_those_of_eap_ports(spec):
    assert eap_ports(spec) == ["eap0"]


def test_what_was_stored_goes_before_the_specification(spec, dictionaries):
    blank = {"eap0": EapDictionary(replace(spec, variables=(), frames=(), sources=()), "eap0")}
    fill_all(blank, dump_all(dictionaries))
    assert dump_all(blank) == dump_all(dictionaries)


@pytest.mark.parametrize("plain", [None, {}, {"version": 99}])
def test_what_was_stored_and_cannot_be_used_does_not(spec, dictionaries, plain):
    made = {"eap0": EapDictionary(spec, "eap0")}
    fill_all(made, {"eap0": plain})
    assert dump_all(made) == dump_all(dictionaries)


def test_plan_tells_all_kinds_of_changes(spec, dictionaries):
    wanted = replace(spec, cycle_us=20_000, sources=(CounterSource("ticks", 3),))
    plan = make_plan(spec, dictionaries, wanted, {})
    assert [(port, change.name) for port, change in plan.changes] == [
        ("eap0", "Configured objects: Device cycle time")
    ]
    assert plan.station == ["source of ticks: changed"]
    assert plan.refused == []
    assert not plan.is_empty
    assert plan.objects() == {"eap0": dump(plan.dictionaries["eap0"])}
    assert make_plan(spec, dictionaries, spec, {}).is_empty


def test_plan_of_what_cannot_be(spec, dictionaries):
    assert make_plan(spec, dictionaries, replace(spec, ports=()), {}).refused
    (frame,) = spec.frames
    nowhere = replace(spec, frames=(replace(frame, pds=()),))
    plan = make_plan(spec, dictionaries, nowhere, {})
    assert "frame carries no enabled PD" in plan.refused[0]
    assert plan.dictionaries == {}


def test_rollback_takes_the_objects_of_then(spec, dictionaries):
    assert plan_rollback(spec, dictionaries, None).refused
    before = replace(spec, cycle_us=20_000)
    objects = dump_all(dictionaries)
    objects["eap0"]["objects"]["F800"]["8"] = "204e0000"
    plan = plan_rollback(spec, dictionaries, Configuration(base="", spec=before, objects=objects))
    assert plan.spec == before
    assert plan.objects() == objects


def test_rollback_with_alternates(stations):
    right = stations[1]
    (pd,) = right.subscriptions
    alternate = RxAlternateSpec(9, (TakenVariableSpec("ticks", "UINT"),))
    both = replace(right, subscriptions=(replace(pd, alternates=(alternate,)),))
    dictionaries = {"eap0": EapDictionary(right, "eap0")}
    fill_all(dictionaries, {})
    previous = Configuration(base="", spec=right, objects={})
    assert plan_rollback(right, dictionaries, previous, both).spec == both
    assert plan_rollback(right, dictionaries, None, both).objects() == dump_all(dictionaries)
    slower = replace(right, cycle_us=20_000)
    before = Configuration(base="", spec=replace(both, cycle_us=20_000))
    for wanted in (slower, before.spec):
        assert plan_rollback(right, dictionaries, before, wanted).spec == wanted
    other = replace(right, cycle_us=20_000)
    assert plan_rollback(right, dictionaries, previous, other).refused == [
        "meanwhile it would go back to something else"
    ]
