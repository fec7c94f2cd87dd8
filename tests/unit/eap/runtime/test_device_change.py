"""Plans of other configurations, and what fills dictionaries."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from eap.device.configuration import dump_configuration
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_spec import read_back
from eap.ids import InterfaceUri, NetId
from eap.pd.spec import (
    BusPortSpec,
    CounterSource,
    GatewayAddress,
    GatewaySpec,
    LinkSpec,
    PortKind,
    PortSpec,
    RxAlternateSpec,
    SentVariableSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.runtime.device_change import (
    describe_rest,
    dump_all,
    eap_ports,
    fill_all,
    find_refusals,
    make_plan,
    plan_rollback,
)
from eap.runtime.store import Configuration


@pytest.fixture
def spec(stations):
    bus = PortSpec(
        "bus0", PortKind.BUS, InterfaceUri.parse("sim://x.yaml"), NetId.parse("1.2.3.4.9.1")
    )
    return replace(stations[0], ports=(*stations[0].ports, bus))


@pytest.fixture
def dictionaries(spec):
    made = {"eap0": EapDictionary(spec, "eap0")}
    fill_all(made, {})
    return made


def test_dictionaries_are_those_of_eap_ports(spec):
    assert eap_ports(spec) == ["eap0"]


def test_fill_all_prefers_stored_objects(spec, dictionaries):
    blank = {"eap0": EapDictionary(replace(spec, variables=(), frames=(), sources=()), "eap0")}
    fill_all(blank, dump_all(dictionaries))
    assert dump_all(blank) == dump_all(dictionaries)


@pytest.mark.parametrize("plain", [None, {}, {"version": 99}])
def test_fill_all_ignores_unusable_stored_objects(spec, dictionaries, plain):
    made = {"eap0": EapDictionary(spec, "eap0")}
    fill_all(made, {"eap0": plain})
    assert dump_all(made) == dump_all(dictionaries)


def test_plan_lists_all_kinds_of_changes(spec, dictionaries):
    wanted = replace(spec, cycle_us=20_000, sources=(CounterSource("ticks", 3),))
    plan = make_plan(spec, dictionaries, wanted, {})
    assert [(port, change.name) for port, change in plan.changes] == [
        ("eap0", "Configured objects: Device cycle time")
    ]
    assert plan.station == ["source of ticks: changed"]
    assert plan.refused == []
    assert not plan.is_empty
    assert plan.objects() == {"eap0": dump_configuration(plan.dictionaries["eap0"])}
    assert make_plan(spec, dictionaries, spec, {}).is_empty


def test_plan_lists_refused_changes(spec, dictionaries):
    assert make_plan(spec, dictionaries, replace(spec, name="other"), {}).refused
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
    alternate = RxAlternateSpec(9, (SentVariableSpec("ticks", "UINT"),))
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


BUS = PortSpec(
    "bus0",
    PortKind.BUS,
    InterfaceUri.parse("sim://x.yaml"),
    NetId.parse("1.2.3.4.9.1"),
    bus=BusPortSpec(),
)


@pytest.fixture
def plain(stations):
    return stations[0]


def with_port(spec, **changes):
    return replace(spec, ports=(replace(spec.ports[0], **changes),))


def test_same_specification_has_no_differences(plain):
    assert find_refusals(plain, plain) == []
    assert describe_rest(plain, plain) == []


def test_describe_rest_leaves_out_dictionary_changes(plain):
    variables = (*plain.variables, VariableSpec("more", "UINT"))
    changed = replace(plain, cycle_us=20_000, variables=variables, frames=())
    assert find_refusals(plain, changed) == []
    assert describe_rest(plain, changed) == []


def test_plan_reports_changed_layout_with_same_version(plain):
    frame = plain.frames[0]
    shorter = replace(frame.pds[0], variables=frame.pds[0].variables[1:])
    changed = replace(plain, frames=(replace(frame, pds=(shorter,)),))
    (line,) = describe_rest(plain, changed)
    assert "PD 'state' (id 7) changes from 19 to 17 bytes" in line


EVERYWHERE = PortSpec(
    "eap1", PortKind.EAP, InterfaceUri.parse("udp://0.0.0.0"), NetId.parse("1.2.3.4.5.9")
)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: replace(s, name="middle"), "station left cannot become middle"),
        (
            lambda s: replace(s, net_id=NetId.parse("9.9.9.9.9.9")),
            "the station's router: net_id 1.1.1.1.1.1 -> 9.9.9.9.9.9",
        ),
        (
            lambda s: replace(s, ports=(*s.ports, EVERYWHERE)),
            "port eap1: udp://0.0.0.0 comes and goes at a start only",
        ),
    ],
)
def test_find_refusals_lists_changes_that_need_new_start(plain, change, words):
    (reason,) = find_refusals(plain, change(plain))
    assert reason.startswith(words)
    assert reason.endswith("restart the appliance")


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            lambda s: with_port(s, net_id="9.9.9.9.9.9"),
            "port eap0: net_id 1.2.3.4.5.1 -> 9.9.9.9.9.9",
        ),
        (lambda s: replace(s, ports=(), frames=()), "port eap0: removed"),
        (lambda s: with_port(s, tcp=True), "port eap0: tcp False -> True"),
        (
            lambda s: replace(s, ports=(*s.ports, replace(s.ports[0], name="eap1"))),
            "port eap1: added at udp://127.9.2.1",
        ),
    ],
)
def test_describe_rest_names_changes_of_ports(plain, change, line):
    assert find_refusals(plain, change(plain)) == []
    assert describe_rest(plain, change(plain)) == [line]


def test_plan_fills_the_dictionary_of_a_new_port(plain):
    pd = TxPdSpec("second", 9, ("running",))
    frame = TxFrameSpec("more", "eap1", "127.9.2.2", (pd,))
    port = replace(plain.ports[0], name="eap1", net_id=NetId.parse("1.2.3.4.5.77"))
    wanted = replace(plain, ports=(*plain.ports, port), frames=(*plain.frames, frame))
    dictionaries = {"eap0": EapDictionary(plain, "eap0")}
    fill_all(dictionaries, {})
    plan = make_plan(plain, dictionaries, wanted, {})
    assert list(plan.dictionaries) == ["eap0", "eap1"]
    assert {name for name, _ in plan.changes} == {"eap1"}
    assert read_back(wanted, plan.dictionaries) == wanted
    back = make_plan(wanted, plan.dictionaries, plain, {})
    assert (back.changes, back.station) == ([], ["port eap1: removed"])


def test_describe_rest_lists_sources_links_and_bus_variables(plain):
    on_bus = VariableSpec("bus0.valve.valve", "BOOL", Writer.ENGINE)
    before = replace(
        plain,
        ports=(*plain.ports, BUS),
        links=(LinkSpec("running", "a"), LinkSpec("ticks", "b", source_bit=3, target_bit=1)),
        variables=(*plain.variables, on_bus),
    )
    after = replace(
        before,
        sources=(CounterSource("ticks", 2), CounterSource("more")),
        links=(LinkSpec("running", "a", swap=True),),
        variables=(*plain.variables, replace(on_bus, writer=Writer.APPLICATION)),
    )
    assert describe_rest(before, after) == [
        "source of ticks: changed",
        "source of more: added",
        "link ticks bit 3 to b bit 1: removed",
        "link running to a: changed",
        "variable bus0.valve.valve: changed",
    ]


def test_describe_rest_lists_settings_and_addresses_of_gateways(plain):
    old = GatewaySpec(rate=5, addresses=(GatewayAddress(0x9001, 1001), GatewayAddress(0x9002, 1)))
    new = GatewaySpec(
        silent=True, rate=6, addresses=(GatewayAddress(0x9002, 2), GatewayAddress(0x9003, 3))
    )
    before = replace(plain, ports=(*plain.ports, replace(BUS, gateway=old)))
    after = replace(plain, ports=(*plain.ports, replace(BUS, gateway=new)))
    assert find_refusals(before, after) == []
    assert describe_rest(before, after) == [
        "gateway of bus0: silent False -> True",
        "gateway of bus0: rate 5 -> 6",
        "gateway of bus0: address 0x9001: removed",
        "gateway of bus0: address 0x9002: changed",
        "gateway of bus0: address 0x9003: added",
    ]
