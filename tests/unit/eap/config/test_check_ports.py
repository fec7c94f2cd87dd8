from __future__ import annotations

import pytest

LEFT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
RIGHT = '"udp://127.0.9.2"'


def left(uri, more=""):
    return LEFT, f'"{uri}", net_id: 127.0.9.1.2.1{more}}}'


@pytest.mark.parametrize(
    ("edits", "finding"),
    [
        ([("plant: pair", "plant: a pair")], "1: plant name 'a pair'; a text without spaces and"),
        ([("name: left", "name: le/ft"), ("left/state", "le/ft/state")], "3: station name 'le/ft'"),
        ([("name: right", "name: left")], "16: station 'left' exists already (line 3); a name of"),
        ([("net_id: 127.0.9.1.1.1", "net_id: 1.2.3")], "4: net_id: '1.2.3' is not an AMS NetID"),
        ([("net_id: 127.0.9.1.1.1", "net_id: 0.0.0.0.0.0")], "4: NetID 0.0.0.0.0.0 stands for"),
        (
            [("net_id: 127.0.9.2.2.1", "net_id: 127.0.9.1.1.1")],
            "19: NetID 127.0.9.1.1.1 is used twice (first in line 4); a NetID of its own",
        ),
        (
            [("net_id: 127.0.9.2.1.1", "net_id: 127.0.9.2.1.1\n    phase_us: 10000")],
            "18: phase_us 10000 is not within the cycle; less than 10000",
        ),
        ([(RIGHT, '"udp://127.0.9.1"')], "19: udp://127.0.9.1 is used twice (first in line 6)"),
        ([left("udp://127.0.9")], "6: interface: '127.0.9' is not an IPv4 address; such as udp"),
        ([left("sim://bus.yaml")], "6: sim:// is no interface of an EAP port; udp, ethernet or t"),
        ([left("udp://239.1.1.1")], "6: 239.1.1.1 is no address of a host"),
        ([left("udp://127.0.9.1?a=1")], "6: udp:// takes no options; udp://127.0.9.1"),
        ([left("udp://127.0.9.1", ", vlan: {id: 3}")], "6: port eap0 has a vlan; it only on"),
        ([left("udp://127.0.9.1", ", vlan: {id: 0}")], "6: id is 0; a whole number from 1 to 4094"),
        ([left("udp://127.0.9.1", ", join: [10.0.0.1]")], "6: '10.0.0.1' cannot be joined; a mult"),
        ([left("udp://127.0.9.1", ", wake: late")], "6: wake is 'late'; one of cycle, arrival"),
    ],
)  # fmt: skip
def test_a_port_that_cannot_be_is_one_finding(findings, edits, finding):
    found = findings(*edits)
    assert any(each.startswith(finding) for each in found), found


@pytest.mark.parametrize(
    ("uri", "more", "finding"),
    [
        ("ethernet://much-too-long-name", "", "'much-too-long-name' is no interface name"),
        ("ethernet://eth0", ", broadcast: true", "port eap0 listens to UDP broadcasts"),
        ("ethernet://eth0", ", mac: 1", "mac is '1'; the address of one station's interface"),
        ("ethernet://eth0", ", mac: 01-00-00-00-00-01", "mac is '01-00-00-00-00-01'; the address"),
        ("udp://127.0.9.1", ", mac: 02-00-00-00-00-01", "port eap0 has a MAC address; it only on"),
        ("ethernet://eth0", ", tcp: true", "port eap0 takes type 4 from TCP"),
        ("ethernet://eth0", ", join: [239.1.1.1]", "'239.1.1.1' cannot be joined"),
        ("loop://line", ", join: [239.1.1.1]", "'239.1.1.1' cannot be joined"),
        ("ethernet://eth0", ", ams: true", "port eap0 says whether AMS is served at its IP addr"),
        ("loop://line", ", ams: false", "port eap0 says whether AMS is served at its IP address"),
        ("udp://127.0.9.1:48899", "", "port number 48899 belongs to AMS; another one, or ams: f"),
        ("tcp://127.0.9.1:48898", "", "port number 48898 belongs to AMS; another one, or ams: f"),
    ],
)
def test_options_belong_to_their_kind_of_interface(findings, uri, more, finding):
    found = findings(left(uri, more), ("to: 127.0.9.2", "to: multicast"))
    assert any(each.startswith(f"6: {finding}") for each in found), found


def test_bus_ports_come_last(findings):
    bus = "      - {name: bus0, kind: bus, interface: sim://line.yaml, net_id: 127.0.9.1.3.1}\n"
    old = "      - {name: eap0, kind: eap, interface: " + LEFT
    assert findings((old, bus + old)) == ["7: EAP port eap0 after a bus port; EAP ports first"]
    assert findings((old, old + "\n" + bus.rstrip())) == []


def test_a_station_needs_a_port_and_a_plant_a_station(findings, tmp_path):
    old = '    ports:\n      - {name: eap0, kind: eap, interface: "udp://127.0.9.2", '
    found = findings((old + "net_id: 127.0.9.2.2.1}\n", "    ports: []\n"))
    assert "18: station right has no ports; an EAP port" in found
    from eap.runtime.plantfile import load_plant

    path = tmp_path / "empty.yaml"
    path.write_text("plant: empty\nstations: []\n")
    assert [str(f) for f in load_plant(path).findings] == [
        f"{path}:2: the plant has no stations; expected at least one station"
    ]


def test_stations_share_an_ethernet_interface_but_ports_of_one_do_not(findings, load_plant):
    def second(more):
        port = "{name: eap1, kind: eap, interface: ethernet://eth0, net_id: 127.0.9.1.3.1"
        return left("ethernet://eth0", f"}}\n      - {port}{more}")

    shared = [("to: 127.0.9.2", "to: multicast"), (RIGHT, '"ethernet://eth0"')]
    assert load_plant(left("ethernet://eth0"), *shared).plant
    assert load_plant(second(", vlan: {id: 7}"), *shared).plant
    assert findings(second(""), *shared) == [
        "7: ethernet://eth0 is used twice (first in line 6); an address of its own for each port"
    ]


def test_udp_and_tcp_of_one_address_are_different_unless_udp_takes_tcp_too(findings):
    def second(more):
        return left(
            "udp://127.0.9.1",
            f"{more}}}\n      - {{name: eap1, kind: eap, interface: tcp://127.0.9.1, "
            "net_id: 127.0.9.1.3.1",
        )

    assert findings(second("")) == []
    assert findings(second(", tcp: true"))[0].startswith("7: tcp://127.0.9.1 is used twice")
