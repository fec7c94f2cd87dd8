from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from eap.config.bus import BusDescription, DescribedEntry, DescribedSlave, name_bus


def slave(*inputs, outputs=(), name="a", **identity):
    return DescribedSlave(
        name=name, vendor=1, product=2, outputs=tuple(outputs), inputs=inputs, **identity
    )


def entry(name, subindex=1, kind="BOOL", index=0x6000):
    return DescribedEntry(name, kind, index, subindex, 1)


def names(*inputs, outputs=()):
    bus = name_bus("bus0", BusDescription((slave(*inputs, outputs=outputs),)))
    [only] = bus.slaves
    return [each.variable.removeprefix("bus0.a.") for each in (*only.outputs, *only.inputs)]


def test_an_unknown_bus_has_its_own_state_only():
    bus = name_bus("bus0", BusDescription())
    assert bus.slaves == ()
    assert {name: kind for name, (kind, _, _) in bus.variables.items()} == {
        "bus0.state": "BYTE",
        "bus0.wkc_ok": "BOOL",
    }


def test_variables_come_with_type_and_direction():
    outputs = [entry("valve", index=0x7000), DescribedEntry("", "", 0, 0, 7)]
    bus = name_bus("b", BusDescription((slave(entry("level", 3, "INT"), outputs=outputs),)))
    assert {name: each[:2] for name, each in bus.variables.items()} == {
        "b.state": ("BYTE", False),
        "b.wkc_ok": ("BOOL", False),
        "b.a.state": ("BYTE", False),
        "b.a.valve": ("BOOL", True),
        "b.a.level": ("INT", False),
    }
    assert bus.variables["b.a.valve"].comment == "output 0x7000:01"
    assert bus.variables["b.a.level"].comment == "input 0x6000:03"


def test_slaves_keep_identity_order_and_padding():
    first = slave(DescribedEntry("", "", 0, 0, 5), entry("x"), serial=7)
    bus = name_bus("bus0", BusDescription((first, slave(name="b", revision=3, alias=9))))
    assert [each.station for each in bus.slaves] == [1001, 1002]
    assert [(each.revision, each.serial, each.alias) for each in bus.slaves] == [
        (None, 7, None),
        (3, None, 9),
    ]
    assert [(each.variable, each.bit_length) for each in bus.slaves[0].inputs] == [
        ("", 5),
        ("bus0.a.x", 1),
    ]


def test_what_cannot_be_in_a_name_is_replaced():
    assert names(entry("Status word/2 (°C)")) == ["Status_word_2___C_"]
    assert names(entry("")) == ["6000_01"]


def test_names_that_are_there_twice_get_their_object():
    twice = [entry("in", 1), entry("in", 0x1A), entry("other", 3)]
    assert names(*twice) == ["in_6000_01", "in_6000_1A", "other"]
    out = entry("in", 1, index=0x7000)
    assert names(entry("in", 1), outputs=[out]) == ["in_7000_01", "in_6000_01"]
    assert names(entry("a b", 1), entry("a_b", 2)) == ["a_b_6000_01", "a_b_6000_02"]


def test_an_entry_called_state_makes_room_for_the_state_of_the_slave():
    assert names(entry("state", 4)) == ["state_6000_04"]


def test_an_entry_that_is_mapped_twice_is_counted():
    assert names(entry("x"), entry("x"), entry("x_6000_01", 2)) == [
        "x_6000_01_2",
        "x_6000_01_3",
        "x_6000_01",
    ]


ENTRIES = st.lists(
    st.builds(
        DescribedEntry,
        st.one_of(st.sampled_from(["x", "x y", "state", "", "x_6000_01"]), st.text(max_size=4)),
        st.sampled_from(["BOOL", "BOOL", ""]),
        st.integers(0x6000, 0x6001),
        st.integers(0, 1),
        st.just(1),
    ),
    max_size=8,
).map(tuple)


@given(ENTRIES, ENTRIES)
def test_names_are_unique_and_can_be_typed(outputs, inputs):
    bus = name_bus("bus0", BusDescription((slave(*inputs, outputs=outputs),)))
    [only] = bus.slaves
    found = [each.variable for each in (*only.outputs, *only.inputs) if each.variable]
    assert len(found) == len(set(found)) == sum(bool(e.type) for e in (*outputs, *inputs))
    assert "bus0.a.state" not in found
    assert set(found) < set(bus.variables)
    for name in found:
        assert not any(each.isspace() or each in "/()" for each in name)
        assert name.count(".") == 2
