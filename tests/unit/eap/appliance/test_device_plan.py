"""What another specification changes beside the dictionaries, and what cannot change."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from eap.appliance.device_plan import describe_rest, find_refusals
from eap.pd.spec import (
    BusPortSpec,
    CounterSource,
    LinkSpec,
    PortKind,
    PortSpec,
    VariableSpec,
    Writer,
)

BUS = PortSpec("bus0", PortKind.BUS, "sim://x.yaml", "1.2.3.4.9.1", bus=BusPortSpec())


@pytest.fixture
def spec(stations):
    return stations[0]


def with_port(spec, **changes):
    return replace(spec, ports=(replace(spec.ports[0], **changes),))


def test_same_specification(spec):
    assert find_refusals(spec, spec) == []
    assert describe_rest(spec, spec) == []


def test_what_the_dictionaries_hold_is_not_told_here(spec):
    variables = (*spec.variables, VariableSpec("more", "UINT"))
    changed = replace(spec, cycle_us=20_000, variables=variables, frames=())
    assert find_refusals(spec, changed) == []
    assert describe_rest(spec, changed) == []


def test_layout_that_changes_under_its_version_is_told(spec):
    frame = spec.frames[0]
    shorter = replace(frame.pds[0], variables=frame.pds[0].variables[1:])
    changed = replace(spec, frames=(replace(frame, pds=(shorter,)),))
    (line,) = describe_rest(spec, changed)
    assert "PD 'state' (id 7) changes from 19 to 17 octets" in line


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: replace(s, name="middle"), "station left cannot become middle"),
        (
            lambda s: replace(s, net_id="9.9.9.9.9.9"),
            "the station's router: net_id 1.1.1.1.1.1 -> 9.9.9.9.9.9",
        ),
        (
            lambda s: with_port(s, net_id="9.9.9.9.9.9"),
            "port eap0: net_id 1.2.3.4.5.1 -> 9.9.9.9.9.9",
        ),
        (lambda s: replace(s, ports=()), "port eap0 is gone"),
        (lambda s: replace(s, ports=(*s.ports, BUS)), "port bus0 is new"),
        (lambda s: with_port(s, tcp=True), "port eap0: tcp False -> True"),
    ],
)
def test_what_needs_a_new_start(spec, change, words):
    (reason,) = find_refusals(spec, change(spec))
    assert reason.startswith(words)
    assert reason.endswith("needs a new start of the appliance")


def test_sources_links_and_variables_of_buses_are_told(spec):
    on_bus = VariableSpec("bus0.valve.valve", "BOOL", Writer.ENGINE)
    before = replace(
        spec,
        ports=(*spec.ports, BUS),
        links=(LinkSpec("running", "a"), LinkSpec("ticks", "b", source_bit=3, target_bit=1)),
        variables=(*spec.variables, on_bus),
    )
    after = replace(
        before,
        sources=(CounterSource("ticks", 2), CounterSource("more")),
        links=(LinkSpec("running", "a", swap=True),),
        variables=(*spec.variables, replace(on_bus, writer=Writer.APPLICATION)),
    )
    assert describe_rest(before, after) == [
        "source of ticks: changed",
        "source of more: added",
        "link ticks bit 3 to b bit 1: removed",
        "link running to a: changed",
        "variable bus0.valve.valve: changed",
    ]
