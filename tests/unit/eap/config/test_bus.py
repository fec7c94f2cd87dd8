from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.config.index import DescribedPdoEntry, DescribedSlave, ExpectedBus, name_bus


def slave(*inputs, outputs=(), name="a", **identity):
    return DescribedSlave(
        name=name, vendor=1, product=2, outputs=tuple(outputs), inputs=inputs, **identity
    )


def entry(name, subindex=1, kind="BOOL", index=0x6000):
    return DescribedPdoEntry(name, kind, index, subindex, 1)


def names(*inputs, outputs=()):
    bus = name_bus("bus0", ExpectedBus((slave(*inputs, outputs=outputs),)))
    [only] = bus.slaves
    return [each.variable.removeprefix("bus0.a.") for each in (*only.outputs, *only.inputs)]


def test_an_unknown_bus_has_its_own_state_only():
    bus = name_bus("bus0", ExpectedBus())
    assert bus.slaves == ()
    assert {name: kind for name, (kind, _, _) in bus.variables.items()} == {
        "bus0.state": "BYTE",
        "bus0.wkc_ok": "BOOL",
    }


def test_variables_come_with_type_and_direction():
    outputs = [entry("valve", index=0x7000), DescribedPdoEntry("", "", 0, 0, 7)]
    bus = name_bus("b", ExpectedBus((slave(entry("level", 3, "INT"), outputs=outputs),)))
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
    first = slave(DescribedPdoEntry("", "", 0, 0, 5), entry("x"), serial=7)
    bus = name_bus("bus0", ExpectedBus((first, slave(name="b", revision=3, alias=9))))
    assert [each.station for each in bus.slaves] == [1001, 1002]
    assert [(each.revision, each.serial, each.alias) for each in bus.slaves] == [
        (None, 7, None),
        (3, None, 9),
    ]
    assert [(each.variable, each.bit_length) for each in bus.slaves[0].inputs] == [
        ("", 5),
        ("bus0.a.x", 1),
    ]


def test_invalid_characters_of_names_are_replaced():
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
        DescribedPdoEntry,
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
    bus = name_bus("bus0", ExpectedBus((slave(*inputs, outputs=outputs),)))
    [only] = bus.slaves
    found = [each.variable for each in (*only.outputs, *only.inputs) if each.variable]
    assert len(found) == len(set(found)) == sum(bool(e.type) for e in (*outputs, *inputs))
    assert "bus0.a.state" not in found
    assert set(found) < set(bus.variables)
    for name in found:
        assert not any(each.isspace() or each in "/()" for each in name)
        assert name.count(".") == 2


PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'


def bus(interface, more="", name="bus0", last=3):
    port = f"{{name: {name}, kind: bus, interface: {interface}, net_id: 127.0.9.1.{last}.1{more}}}"
    return f"\n      - {port}"


def with_bus(*args, **kwargs):
    return PORT, PORT + bus(*args, **kwargs)


@pytest.mark.parametrize(
    ("interface", "more"),
    [
        ("sim://line.yaml", ""),
        ("sim://line.yaml", ", bus: line.yaml"),
        ("ethernet://eth1", ""),
        ("ethernet://eth1", ", bus: line.yaml, target: PREOP, clocks: true"),
        ("udp://127.0.9.7:40000", ", bus: line.yaml"),
    ],
)
def test_these_are_bus_ports(findings, interface, more):
    assert findings(with_bus(interface, more)) == []


@pytest.mark.parametrize(
    ("interface", "more", "finding"),
    [
        ("tcp://127.0.9.3", "", "tcp:// is no interface of a bus port; sim:// and a bus file, eth"),
        ("loop://a", "", "loop:// is no interface of a bus port"),
        ("line.yaml", "", "interface: 'line.yaml' is not an interface (one of udp"),
        ("sim://", "", "interface: 'sim://' names no interface"),
        ("sim://line.yaml?a=1", "", "sim:// takes no options; sim://line.yaml"),
        ("sim://none.yaml", "", "bus file none.yaml does not exist; a bus file, its path from"),
        (f"sim://{300 * 'x'}", "", f"bus file {300 * 'x'} cannot be read: File name"),
        ("sim://.", "", "bus file . is no regular file"),
        ("ethernet://eth1", ", bus: none.yaml", "bus file none.yaml does not exist"),
        ("sim://line.yaml", ", bus: x.yaml", "port bus0 simulates line.yaml, but is described by"),
        ("ethernet://much-too-long-name", "", "'much-too-long-name' is no interface name"),
        ("udp://239.1.1.1", "", "239.1.1.1 is no address of a bus; the address of one segment"),
        ("udp://0.0.0.0", "", "0.0.0.0 is no address of a bus"),
        ("udp://255.255.255.255", "", "255.255.255.255 is no address of a bus"),
        ("sim://line.yaml", ", target: BOOT", "target is 'BOOT'; one of INIT, PREOP, SAFEOP, OP"),
        ("sim://line.yaml", ", clocks: 1", "clocks is 1; true or false"),
        ("sim://line.yaml", ", frame_timeout_us: 1999", "frame_timeout_us is 1999; "),
        ("sim://line.yaml", ", frame_retries: 21", "frame_retries is 21; "),
        ("sim://line.yaml", ', redundant: "ethernet://b"', "ethernet://b is no second line beside"),
        ("sim://line.yaml", ', redundant: "sim://x.yaml"', "the second line simulates x.yaml"),
        (
            "sim://line.yaml",
            ', redundant: "sim://line.yaml"',
            "line.yaml has one line to the master",
        ),
        ("ethernet://a", ', redundant: "ethernet://a"', "ethernet://a is the first line, too"),
        ("ethernet://a", ', redundant: "b"', "redundant: 'b' is not an interface"),
        (
            "udp://127.0.9.9",
            ', redundant: "udp://127.0.9.1"',
            "udp://127.0.9.1 is the interface of",
        ),
        (
            "sim://line.yaml",
            ", lock_cycle: true",
            "the clocks of bus0 are not kept together; clocks:",
        ),
        ("sim://line.yaml", ", sync_lead_us: -1", "sync_lead_us is -1; "),
        ("sim://line.yaml", ", wake: arrival", "bus0 is a port of kind bus, wake belongs to EAP"),
        ("sim://line.yaml", ", vlan: {id: 3}", "bus0 is a port of kind bus, vlan belongs to EAP"),
        ("sim://line.yaml", ", broadcast: false", "bus0 is a port of kind bus, broadcast belongs"),
        ("udp://127.0.9.1", "", "udp://127.0.9.1 is used twice (first in line 6)"),
        ("udp://127.0.9.1:34980", "", "udp://127.0.9.1:34980 is used twice (first in line 6)"),
    ],
)
def test_invalid_bus_port_is_one_finding(findings, tmp_path, interface, more, finding):
    found = findings(with_bus(f'"{interface}"', more))
    [only] = [each.replace(f"{tmp_path}/", "").replace(str(tmp_path), ".") for each in found]
    assert only.startswith(f"7: {finding}")


def test_keys_of_buses_are_none_of_eap_ports(findings):
    found = findings((PORT, PORT.replace("}", ", clocks: false}")))
    assert found == [
        "6: eap0 is a port of kind eap, clocks belongs to bus ports; no clocks on EAP ports"
    ]


def test_the_findings_of_a_bus_file_follow_once_with_its_name(load_plant, tmp_path):
    use = "    links:\n      - {from: bus0.valves.limit, to: bus1.valves.valve}\n    sources:"
    both = bus("sim://broken.yaml") + bus("sim://broken.yaml", name="bus1", last=4)
    result = load_plant((PORT, PORT + both), ("    sources:", use), ("id: 1,", "id: 70000,"))
    assert [str(each) for each in result.findings] == [
        f"{tmp_path}/plant.yaml:19: id is 70000; expected a whole number from 0 to 65535",
        f"{tmp_path}/broken.yaml:3: kind is 'x'; expected one of a, b",
    ]


def test_two_ports_may_simulate_one_file(load_plant):
    both = bus("sim://line.yaml") + bus("sim://line.yaml", name="bus1", last=4)
    ports = load_plant((PORT, PORT + both)).plant.stations[0].ports
    assert ports[1].bus.file == ports[2].bus.file
    assert ports[2].bus.slaves[0].inputs[0].variable == "bus1.valves.limit"


@pytest.mark.parametrize("uri", ["ethernet://eth1", "udp://127.0.9.7"])
def test_a_real_bus_has_one_port(findings, uri):
    both = bus(uri) + bus(uri, name="bus1", last=4)
    assert findings((PORT, PORT + both)) == [
        f"8: {uri} is used twice (first in line 7); an address of its own for each port"
    ]


def test_an_eap_port_is_not_on_the_interface_of_a_bus(findings):
    eap = '"ethernet://eth1", net_id: 127.0.9.1.2.1}'
    shared = (PORT, eap + bus("ethernet://eth1")), ("to: 127.0.9.2", "to: multicast")
    found = findings(*shared, ('"udp://127.0.9.2"', '"ethernet://eth1"'))
    assert found == [
        (
            "7: ethernet://eth1 is the interface of eap0 too (line 6): the slaves of bus0 would"
            " forward and return the frames of eap0; an interface of its own for a bus"
        )
    ]


def test_bus_variable_has_the_prefix_of_its_port(findings):
    twice = "count: UDINT\n      bus0.valves.valve: BOOL"
    assert findings(with_bus("sim://line.yaml"), ("count: UDINT", twice)) == [
        "7: variable 'bus0.valves.valve' exists already (line 11); a name of its own"
    ]
