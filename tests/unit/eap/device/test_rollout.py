from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from eap.codec import datatypes
from eap.device.rollout import (
    PdKey,
    Step,
    kept_versions,
    lay_out,
    sent_pds,
    steps,
    without_alternates,
)
from eap.ids import NetId
from eap.pd.spec import (
    RxAlternateSpec,
    RxPdSpec,
    SentVariableSpec,
    StationSpec,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from tests.support.cyclic import OWN, eap_port, station, written

LAYOUTS = (
    {"n": "UINT"},
    {"n": "UINT", "on": "BOOL"},
    {"on": "BOOL", "level": "REAL", "n": "UINT"},
    {"n": "UDINT"},
    {"level": "REAL"},
)
"""A PD's variables by its version."""

Plant = dict[str, StationSpec]


def net_id(number: int) -> str:
    return f"5.1.1.{number}.1.1"


def plant(
    versions: Mapping[tuple[str, int], int],
    received: Mapping[str, Sequence[tuple[str, int]]],
    *,
    ignoring: bool = False,
) -> Plant:
    """Stations of one letter; *versions* of the PDs each sends by id, and what each receives."""
    names = sorted({station for station, _ in versions} | set(received))
    found = {}
    for number, name in enumerate(names, 1):
        sent = {pd_id: version for (who, pd_id), version in versions.items() if who == name}
        taken = [(who, pd_id, versions[who, pd_id]) for who, pd_id in received.get(name, ())]
        found[name] = StationSpec(
            name, NetId.parse(net_id(100 + number)), 1000, (eap_port(net_id=net_id(number)),),
            variables=tuple(_variables(sent, taken)),
            frames=(
                TxFrameSpec("f", "eap0", "somewhere", tuple(
                    TxPdSpec(f"pd{pd_id}", pd_id,
                             tuple(f"{pd_id}.{each}" for each in LAYOUTS[version]), version)
                    for pd_id, version in sent.items()
                )),
            ),
            subscriptions=tuple(
                RxPdSpec(f"{who}{pd_id}", "eap0", pd_id,
                         tuple(f"{who}{pd_id}.{each}" for each in LAYOUTS[version]),
                         net_id(1 + names.index(who)), version, ignore_version=ignoring)
                for who, pd_id, version in taken
            ),
        )  # fmt: skip
    return found


def _variables(
    sent: Mapping[int, int], taken: Sequence[tuple[str, int, int]]
) -> Iterator[VariableSpec]:
    for pd_id, version in sent.items():
        for name, kind in LAYOUTS[version].items():
            yield VariableSpec(f"{pd_id}.{name}", kind)
    for who, pd_id, version in taken:
        for name, kind in LAYOUTS[version].items():
            yield VariableSpec(f"{who}{pd_id}.{name}", kind, Writer.ENGINE)


def size(types: Sequence[str]) -> int:
    return datatypes.layout([datatypes.parse(each) for each in types]).size


def mismatches(running: Plant) -> list[str]:
    """Subscriptions that discard what somebody sends them."""
    sent: dict[tuple[str, int], tuple[int, int]] = {}
    for spec in running.values():
        types = {each.name: each.type for each in spec.variables}
        for frame in spec.frames:
            for pd in frame.pds:
                key = str(spec.ports[0].net_id), pd.pd_id
                sent[key] = pd.version, size([types[name] for name in pd.variables])
    return [
        f"{spec.name} {pd.name}"
        for spec in running.values()
        for pd in spec.subscriptions
        for (publisher, pd_id), what in sent.items()
        if pd_id == pd.pd_id
        and pd.publisher in ("", publisher)
        and publisher != str(spec.ports[0].net_id)
        and not takes(pd, {each.name: each.type for each in spec.variables}, what)
    ]


def takes(pd: RxPdSpec, types: Mapping[str, str], what: tuple[int, int]) -> bool:
    own = size([types[name] for name in pd.variables])
    others = {(each.version, size([v.type for v in each.variables])) for each in pd.alternates}
    return what in {(pd.version, own), *others} or (pd.ignore_version and own == what[1])


def follow(old: Plant, new: Plant, *, until: int | None = None) -> tuple[list[Step], Plant]:
    """Go the way from *old* to *new* (its first *until* steps), looking at what is received."""
    running = dict(old)
    way = steps(old, new)
    for step in way[:until]:
        assert running[step.station] != step.spec, f"{step.why}: nothing is different"
        running[step.station] = step.spec
        assert mismatches(running) == [], step
    return way, running


def shown(way: Sequence[Step]) -> list[str]:
    return [f"{step.station} {step.why}" for step in way]


def test_nothing_changes_without_a_difference():
    old = plant({("a", 1): 0}, {"b": [("a", 1)]})
    assert steps(old, dict(old)) == []


def test_the_receiver_goes_first_and_once_more():
    received = {"b": [("a", 1)], "c": []}
    old, new = plant({("a", 1): 0}, received), plant({("a", 1): 1}, received)
    way, running = follow(old, new)
    assert shown(way) == [
        "b runs the new configuration; accepts old layouts too",
        "a runs the new configuration",
        "b accepts no old layouts any more",
    ]
    assert running == new
    assert without_alternates(way[0].spec) == new["b"]
    assert way[0].spec.subscriptions[0].alternates == (
        RxAlternateSpec(0, (SentVariableSpec("a1.n", "UINT"),)),
    )


def test_changed_or_removed_variable_is_not_copied():
    received = {"b": [("a", 1)]}
    old, new = plant({("a", 1): 2}, received), plant({("a", 1): 3}, received)
    first = steps(old, new)[0].spec.subscriptions[0]
    assert [(each.name, each.type) for each in first.alternates[0].variables] == [
        ("", "BOOL"),
        ("", "REAL"),
        ("", "UINT"),
    ]


def test_stations_that_send_and_receive_take_both_before_they_send_anew():
    received = {"a": [("b", 2)], "b": [("a", 1)]}
    versions = {("a", 1): 0, ("b", 2): 0}
    old, new = plant(versions, received), plant(dict.fromkeys(versions, 1), received)
    way, running = follow(old, new)
    assert shown(way) == [
        "a accepts old and new layouts; sends as before",
        "b accepts old and new layouts; sends as before",
        "a runs the new configuration; accepts old layouts too",
        "b runs the new configuration",
        "a accepts no old layouts any more",
    ]
    assert running == new
    assert without_alternates(way[0].spec) == old["a"]


def test_in_a_line_senders_follow_each_other():
    versions = {("c", 1): 0, ("b", 2): 0, ("a", 3): 0}
    received = {"b": [("c", 1)], "a": [("b", 2)], "d": [("a", 3)]}
    way, running = follow(plant(versions, received), plant(dict.fromkeys(versions, 1), received))
    assert [step.station for step in way] == ["a", "b", "d", "c", "b", "a", "d"]
    assert running == plant(dict.fromkeys(versions, 1), received)


def test_station_with_unchanged_pds_has_one_step():
    received = {"b": [("a", 1)], "c": [("a", 1)]}
    old, new = (
        plant({("a", 1): 0, ("c", 9): 0}, received),
        plant({("a", 1): 1, ("c", 9): 0}, received),
    )
    old["d"], new["d"] = replace(new["c"], name="d", cycle_us=1), replace(new["c"], name="d")
    old["d"] = replace(old["d"], subscriptions=(), frames=())
    new["d"] = replace(new["d"], subscriptions=(), frames=())
    way, _ = follow(old, new)
    assert [step.station for step in way].count("d") == 1


def test_new_receiver_of_changed_pd_waits_for_its_sender():
    old = plant({("a", 1): 0}, {"b": []})
    new = plant({("a", 1): 1}, {"b": [("a", 1)]})
    way, _ = follow(old, new)
    assert shown(way) == ["a runs the new configuration", "b runs the new configuration"]


def test_former_receiver_changes_first():
    old = plant({("a", 1): 0}, {"b": [("a", 1)]})
    new = plant({("a", 1): 1}, {"b": []})
    way, _ = follow(old, new)
    assert [step.station for step in way] == ["b", "a"]
    assert way[0].spec == new["b"]


def test_new_pds_are_accepted_before_they_are_sent_and_old_ones_until_they_end():
    received = {"a": [("b", 2)], "b": []}
    old = plant({("b", 2): 0}, received)
    new = plant({("b", 2): 0, ("b", 3): 0}, {"a": [("b", 2), ("b", 3)]})
    assert [step.station for step in steps(old, new)] == ["a", "b"]
    assert [step.station for step in steps(new, old)] == ["b", "a"]


def test_receiver_of_changing_and_ending_pds_changes_last():
    received = {"a": [("b", 2), ("b", 3)]}
    old = plant({("b", 2): 0, ("b", 3): 0}, received)
    new = plant({("b", 2): 1}, {"a": [("b", 2)]})
    way, _ = follow(old, new)
    assert shown(way) == [
        "a accepts old and new layouts; sends as before",
        "b runs the new configuration",
        "a runs the new configuration",
    ]


def paced(old: Plant, step: int, version: int = 0) -> Plant:
    """Return *old* with station a sending PD 1 every *step* cycles, in a layout."""
    fresh = plant({("a", 1): version}, {"b": [("a", 1)]})
    (frame,) = fresh["a"].frames
    pd = replace(frame.pds[0], trigger=TriggerSpec(divider=step))
    taken = replace(fresh["b"].subscriptions[0], step=step)
    return {
        "a": replace(fresh["a"], frames=(replace(frame, pds=(pd,)),)),
        "b": replace(fresh["b"], subscriptions=(taken,)),
    }


def test_receiver_expects_the_smaller_of_two_rates():
    line = plant({("a", 1): 0}, {"b": [("a", 1)]})
    often, seldom, unknown = paced(line, 1), paced(line, 2), paced(line, 0)
    for faster, slower in ((often, seldom), (seldom, unknown), (often, unknown)):
        assert [step.station for step in steps(faster, slower)] == ["b", "a"]
        assert [step.station for step in steps(slower, faster)] == ["a", "b"]
    assert [step.station for step in steps(paced(line, 1), paced(line, 2, version=1))] == [
        *["b", "a", "b"]
    ]
    back = steps(paced(line, 2, version=1), paced(line, 1))
    assert [(step.station, step.spec.subscriptions[0].step) for step in back[::2]] == [
        ("b", 2),
        ("b", 1),
    ]
    assert back[1].station == "a"


def test_stations_that_are_in_one_plant_only_have_no_step():
    old = plant({("a", 1): 0}, {"b": [("a", 1)]})
    new = plant({("a", 1): 1, ("c", 3): 0}, {"b": [("a", 1)]})
    del old["b"]
    assert [step.station for step in steps(old, new)] == ["a"]


def test_any_publisher_accepts_all_layouts():
    received = {"d": [("a", 1), ("b", 1)]}
    plants = []
    for versions in ({("a", 1): 0, ("b", 1): 0}, {("a", 1): 1, ("b", 1): 1}):
        made = plant(versions, received)
        first = replace(made["d"].subscriptions[0], publisher="")
        made["d"] = replace(made["d"], subscriptions=(first,))
        plants.append(made)
    way, running = follow(*plants)
    assert [step.station for step in way] == ["d", "a", "b", "d"]
    assert len(way[0].spec.subscriptions[0].alternates) == 1
    assert running == plants[1]


def test_a_version_that_is_ignored_needs_no_alternate():
    received = {"b": [("a", 1)]}
    old, new = (plant({("a", 1): 0}, received, ignoring=True) for _ in range(2))
    pd = replace(new["a"].frames[0].pds[0], version=9)
    new["a"] = replace(new["a"], frames=(replace(new["a"].frames[0], pds=(pd,)),))
    way, _ = follow(old, new)
    assert shown(way) == ["a runs the new configuration"]


def test_pd_without_sender_gets_no_alternate():
    old = plant({("a", 1): 0}, {"b": [("a", 1)]})
    new = plant({("a", 1): 1}, {"b": [("a", 1)]})
    for each in (old, new):  # b is for something that neither sends
        pd = replace(each["b"].subscriptions[0], version=77)
        each["b"] = replace(each["b"], subscriptions=(pd,))
    assert [step.station for step in steps(old, new)] == ["a", "b"]
    assert all(not pd.alternates for step in steps(old, new) for pd in step.spec.subscriptions)


STATIONS = "abcd"
PDS = [(station, 10 * number + pd) for number, station in enumerate(STATIONS) for pd in (1, 2)]
versions_of_all = st.fixed_dictionaries(
    {}, optional={key: st.integers(0, len(LAYOUTS) - 1) for key in PDS}
)
wishes = st.fixed_dictionaries({name: st.sets(st.sampled_from(PDS)) for name in STATIONS})


@st.composite
def plants(draw: st.DrawFn) -> Plant:
    versions = draw(versions_of_all)
    received = {
        name: [key for key in PDS if key in wanted and key in versions and key[0] != name]
        for name, wanted in draw(wishes).items()
    }
    return plant(versions, received)


@given(plants(), plants())
def test_receivers_accept_every_pd_during_any_change(old, new):
    way, running = follow(old, new)
    assert running == new
    counts = {name: sum(step.station == name for step in way) for name in STATIONS}
    assert all((old[name] != new[name]) <= counts[name] <= 3 for name in STATIONS)
    assert not any(counts[name] for name in STATIONS if old[name] == new[name])
    assert steps(old, new) == way


@given(plants(), plants(), plants(), st.integers(0, 12))
def test_a_change_that_was_broken_off_can_be_finished_taken_back_or_followed_by_another(
    old, new, another, done
):
    _, broken_off = follow(old, new, until=done)
    for goal in (old, new, another):
        assert follow(broken_off, goal)[1] == goal


def test_receiver_of_its_own_pd_changes_both_ends_at_once():
    received = {"a": [("a", 1)]}
    way = steps(plant({("a", 1): 0}, received), plant({("a", 1): 1}, received))
    assert shown(way) == ["a runs the new configuration"]


def test_in_a_ring_only_the_first_needs_a_third_step():
    count = 100
    versions = {(f"s{n:03}", n): 0 for n in range(count)}
    received = {f"s{n:03}": [(f"s{(n + 1) % count:03}", (n + 1) % count)] for n in range(count)}
    old, new = plant(versions, received), plant(dict.fromkeys(versions, 1), received)
    assert len(steps(old, new)) == 2 * count + 1


def test_variables_lie_in_pdo_order_under_the_one_name_of_their_type():
    layout = lay_out(3, [("on", "BOOL"), ("off", "bit"), ("level", "real")])
    assert (layout.version, layout.size) == (3, 5)
    assert layout.variables == (("on", "BOOL", 0), ("off", "BIT1", 1), ("level", "REAL", 8))


def test_a_pd_is_known_by_the_port_that_sends_it_and_its_id():
    pds = (TxPdSpec("p", 1, ("a",), 5), TxPdSpec("q", 2, ("a",)))
    spec = station(
        variables=written("a:UINT"), frames=(TxFrameSpec("f", "eap0", "somewhere", pds),)
    )
    assert list(sent_pds(spec)) == [
        (PdKey(OWN, 1), pds[0], lay_out(5, [("a", "UINT")])),
        (PdKey(OWN, 2), pds[1], lay_out(0, [("a", "UINT")])),
    ]


def sending(version: int, *variables: str, pd_id: int = 7) -> StationSpec:
    """A station that sends *variables*, written as ``name:type``, as one PD."""
    names = tuple(variable.partition(":")[0] for variable in variables)
    pd = TxPdSpec("report", pd_id, names, version)
    return station(
        variables=written(*variables), frames=(TxFrameSpec("f", "eap0", "somewhere", (pd,)),)
    )


@pytest.mark.parametrize(
    ("new", "told"),
    [
        (sending(1, "a:UINT", "b:UINT", "c:BOOL"), "changes from 4 to 5 bytes"),
        (sending(1, "a:UINT"), "changes from 4 to 2 bytes"),
        (sending(1, "a:UINT", "b:INT"), "keeps its size with other variables"),
        (sending(1, "a:UDINT"), "keeps its size with other variables"),
        (sending(1, "b:UINT", "a:UINT"), "keeps its size with other variables"),
        (sending(1, "c:UINT", "a:UINT"), "keeps its size with other variables"),
    ],
)
def test_changed_layout_with_same_version_is_reported(new, told):
    (line,) = kept_versions(sending(1, "a:UINT", "b:UINT"), new)
    assert line.startswith(f"PD 'report' (id 7) {told}")
    assert "its version stays 1" in line


@pytest.mark.parametrize(
    "new",
    [
        sending(1, "a:UINT", "b:UINT"),
        sending(1, "a:UINT", "renamed:UINT"),
        sending(2, "a:UINT"),
        sending(1, "a:UDINT", pd_id=8),
        station(),
    ],
)
def test_changed_layout_with_new_version_is_not_reported(new):
    assert kept_versions(sending(1, "a:UINT", "b:UINT"), new) == []
