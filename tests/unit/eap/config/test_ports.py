from __future__ import annotations

import pytest

from eap.config.ports import group_of, reaches, resolve_destination
from eap.config.structs import PortSection, VlanSection
from eap.ids import Destination, InterfaceUri, NetId
from eap.pd.spec import PortKind

RIGHT = '"udp://127.0.9.2"'
LEFT_PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'


def left(uri, more=""):
    return LEFT_PORT, f'"{uri}", net_id: 127.0.9.1.2.1{more}}}'


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
def test_invalid_port_is_one_finding(findings, edits, finding):
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
        ("ethernet://eth0", ", tcp: true", "port eap0 receives type 4 over TCP"),
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
    old = "      - {name: eap0, kind: eap, interface: " + LEFT_PORT
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


def port(interface, **options):
    made = PortSection(
        name="p",
        kind=PortKind.EAP,
        interface=interface,
        net_id=NetId.parse("1.1.1.1.1.1"),
        **options,
    )
    return made, InterfaceUri.parse(interface)


@pytest.mark.parametrize(
    ("text", "interface", "destination"),
    [
        ("10.0.0.2", "udp://10.0.0.1", "10.0.0.2"),
        ("10.0.0.2:4000", "udp://10.0.0.1", "10.0.0.2:4000"),
        ("tcp://10.0.0.2", "udp://10.0.0.1", "tcp://10.0.0.2"),
        ("tcp://10.0.0.2", "tcp://10.0.0.1", "tcp://10.0.0.2"),
        ("broadcast", "udp://10.0.0.1", "255.255.255.255"),
        ("broadcast", "ethernet://eth0", "ff:ff:ff:ff:ff:ff"),
        ("multicast", "ethernet://eth0", "01:01:05:04:00:00"),
        ("02-00-00-00-00-01", "ethernet://eth0", "02:00:00:00:00:01"),
        ("right/eap0", "udp://127.0.9.1", "127.0.9.2"),
        ("right/eap0", "tcp://127.0.9.1", ValueError),  # the port takes no TCP
        ("right/eap0", "ethernet://eth0", ValueError),
        ("right/eap9", "udp://127.0.9.1", ValueError),
        ("multicast", "udp://127.0.9.1", ValueError),
        ("broadcast", "tcp://127.0.9.1", ValueError),
        ("tcp://239.1.1.1", "udp://127.0.9.1", ValueError),
        ("10.0.0.2", "tcp://10.0.0.1", ValueError),
        ("10.0.0.2", "ethernet://eth0", ValueError),
        ("02:00:00:00:00:01", "udp://10.0.0.1", ValueError),
        ("here", "udp://10.0.0.1", ValueError),
        ("127.0.9.2.2.1", "udp://127.0.9.1", "127.0.9.2"),  # of a port
        ("127.0.9.2.1.1", "udp://127.0.9.1", "127.0.9.2"),  # of a router
        ("5.5.5.5.1.1", "udp://127.0.9.1", ValueError),
        ("5.5.5.5.1.1", "ethernet://eth0", "5.5.5.5.1.1"),
        ("0.0.0.0.0.0", "ethernet://eth0", ValueError),
    ],
)
def test_valid_destination_becomes_an_address(index, text, interface, destination):
    if destination is ValueError:
        with pytest.raises(ValueError, match=r"."):
            resolve_destination(text, InterfaceUri.parse(interface), index())
    else:
        assert str(resolve_destination(text, InterfaceUri.parse(interface), index())) == destination


@pytest.mark.parametrize(
    ("interface", "sender", "destination"),
    [
        ("udp://127.0.9.2:4000", "udp://127.0.9.1", "127.0.9.2:4000"),
        ("tcp://127.0.9.2", "udp://127.0.9.1", "tcp://127.0.9.2"),
        ("loop://line", "loop://line", "01:01:05:04:00:00"),
        ("ethernet://eth1", "ethernet://eth0", "127.0.9.2.2.1"),
    ],
)
def test_a_port_of_the_plant_has_an_address(index, interface, sender, destination):
    plant = index(('"udp://127.0.9.2"', f'"{interface}"'))
    assert str(resolve_destination("right/eap0", InterfaceUri.parse(sender), plant)) == destination


def test_a_router_with_several_ports_has_no_address(index):
    plant = index(
        (
            "net_id: 127.0.9.2.2.1}",
            """net_id: 127.0.9.2.2.1}
      - {name: eap1, kind: eap, interface: "udp://127.0.9.3", net_id: 127.0.9.2.3.1}""",
        )
    )
    uri = InterfaceUri.parse("udp://127.0.9.1")
    assert str(resolve_destination("127.0.9.2.3.1", uri, plant)) == "127.0.9.3"
    with pytest.raises(ValueError, match="with several ports: right/eap0, right/eap1"):
        resolve_destination("127.0.9.2.1.1", uri, plant)


def test_a_udp_port_that_takes_tcp_has_a_tcp_address(index):
    plant = index(("net_id: 127.0.9.2.2.1", "net_id: 127.0.9.2.2.1, tcp: true"))
    uri = InterfaceUri.parse("tcp://127.0.9.1")
    assert str(resolve_destination("right/eap0", uri, plant)) == "tcp://127.0.9.2"


@pytest.mark.parametrize(
    ("destination", "sender", "receiver", "arrives"),
    [
        ("1.1.1.1.1.1", port("ethernet://eth0"), port("ethernet://eth1"), True),
        (
            "1.1.1.1.1.1",
            port("ethernet://eth0"),
            port("ethernet://eth1", vlan=VlanSection(id=2)),
            False,
        ),
        ("1.1.1.1.1.2", port("ethernet://eth0"), port("ethernet://eth1"), False),
        ("10.0.0.2", port("udp://10.0.0.1"), port("udp://10.0.0.2"), True),
        ("10.0.0.2", port("udp://10.0.0.1"), port("udp://10.0.0.3"), False),
        ("10.0.0.2", port("udp://10.0.0.1"), port("udp://0.0.0.0"), True),
        ("10.0.0.2", port("udp://10.0.0.1"), port("udp://10.0.0.2:4000"), False),
        ("10.0.0.2:34980", port("udp://10.0.0.1"), port("udp://10.0.0.2"), True),
        ("10.0.0.2", port("udp://10.0.0.1"), port("tcp://10.0.0.2"), False),
        ("239.1.1.1", port("udp://10.0.0.1"), port("udp://10.0.0.2"), True),
        ("255.255.255.255", port("udp://10.0.0.1"), port("udp://10.0.0.2"), True),
        ("10.0.0.255", port("udp://10.0.0.1"), port("udp://10.0.0.2"), False),
        ("10.0.0.255", port("udp://10.0.0.1"), port("udp://10.0.0.2", broadcast=True), True),
        ("tcp://10.0.0.2", port("tcp://10.0.0.1"), port("tcp://10.0.0.2"), True),
        ("tcp://10.0.0.2", port("udp://10.0.0.1"), port("udp://10.0.0.2"), False),
        ("tcp://10.0.0.2", port("udp://10.0.0.1"), port("udp://10.0.0.2", tcp=True), True),
        ("01:01:05:04:00:00", port("ethernet://a"), port("ethernet://b"), True),
        ("01:01:05:04:00:00", port("ethernet://a"), port("udp://10.0.0.1"), False),
        (
            "02:00:00:00:00:01",
            port("ethernet://a"),
            port("ethernet://b", vlan=VlanSection(id=5)),
            False,
        ),
        (
            "02:00:00:00:00:01",
            port("ethernet://a", vlan=VlanSection(id=5)),
            port("ethernet://b", vlan=VlanSection(id=5, priority=3)),
            True,
        ),
        ("01:01:05:04:00:00", port("loop://a"), port("loop://a"), True),
        ("01:01:05:04:00:00", port("loop://a"), port("loop://b"), False),
        ("01:01:05:04:00:00", port("ethernet://a"), port("loop://a"), False),
    ],
)
def test_a_frame_arrives_where_its_address_is(destination, sender, receiver, arrives):
    assert reaches(Destination.parse(destination), sender, receiver) is arrives


@pytest.mark.parametrize(
    ("destination", "group"),
    [
        ("10.0.0.2", None),
        ("255.255.255.255", None),
        ("239.1.1.1", "239.1.1.1"),
        ("01:01:05:04:00:00", None),  # every Ethernet port listens to it
        ("ff:ff:ff:ff:ff:ff", None),
        ("02:00:00:00:00:01", None),
        ("01:01:05:04:00:07", "01:01:05:04:00:07"),
    ],
)
def test_groups_are_what_one_has_to_join(destination, group):
    assert group_of(Destination.parse(destination)) == group


LEFT = '"udp://127.0.9.1"'
ETHERNET = ((LEFT, '"ethernet://eth0"'), (RIGHT, '"ethernet://eth1"'))
TO = "to: 127.0.9.2}"
RIGHT_ID = "net_id: 127.0.9.2.2.1}"
TCP = RIGHT_ID, "net_id: 127.0.9.2.2.1, tcp: true}"
SENDS_BACK = """
    variables: {back: UINT}
    frames:
      - {name: back, port: eap0, to: TARGET}
    publish:
      - {name: back, frame: back, id: 9, variables: [back]}
    subscribe:"""


def to(text):
    return TO, f"to: {text}}}"


def back(target):
    return "\n    subscribe:", SENDS_BACK.replace("TARGET", target)


def test_net_id_with_the_mac_of_its_port(load_plant):
    mac = RIGHT_ID, "net_id: 127.0.9.2.2.1, mac: 02-00-00-00-00-0A}"
    for text in ("right/eap0", "127.0.9.2.2.1", "127.0.9.2.1.1"):
        result = load_plant(*ETHERNET, to(text), mac)
        assert result.findings == ()
        frame = result.plant.stations[0].frames[0]
        assert (frame.destination, frame.mac) == ("127.0.9.2.2.1", "02:00:00:00:00:0a")


@pytest.mark.parametrize("target", ["multicast", "broadcast", "02:00:00:00:00:01"])
def test_net_id_is_learned_from_what_its_port_sends(load_plant, target):
    result = load_plant(*ETHERNET, to("right/eap0"), back(target))
    assert result.findings == ()
    frame = result.plant.stations[0].frames[0]
    assert (frame.destination, frame.mac) == ("127.0.9.2.2.1", "")


def test_net_id_is_learned_only_from_groups_that_its_sender_has_joined(findings):
    group = "01:01:05:04:00:07"
    assert len(findings(*ETHERNET, to("right/eap0"), back(group))) == 1
    join = "net_id: 127.0.9.1.2.1}", f'net_id: 127.0.9.1.2.1, join: ["{group}"]}}'
    assert findings(*ETHERNET, to("right/eap0"), back(group), join) == []
    publish = "    publish:\n      - {name: state,"
    takes = publish, f"    subscribe: [{{name: b, port: eap0, from: right/back}}]\n{publish}"
    assert findings(*ETHERNET, to("right/eap0"), back(group), takes) == []


def test_net_id_on_udp_is_the_address_of_its_port(load_plant):
    result = load_plant(to("127.0.9.2.2.1"))
    assert result.plant.stations[0].frames[0].destination == "127.0.9.2"


def test_net_id_that_cannot_be_learned_is_a_finding(findings):
    (only,) = findings(*ETHERNET, to("127.0.9.2.2.1"))
    assert only.startswith(
        "13: frame 'out' goes to the NetID of right/eap0, whose MAC address cannot"
    )
    assert only.endswith("; such a frame, or mac: on that port (line 19)")


def test_frames_that_need_each_other_to_learn_a_mac_are_findings(findings):
    assert len(findings(*ETHERNET, to("right/eap0"), back("left/eap0"))) == 2
    mac = "net_id: 127.0.9.1.2.1}", 'net_id: 127.0.9.1.2.1, mac: "02:00:00:00:00:01"}'
    assert findings(*ETHERNET, to("right/eap0"), back("left/eap0"), mac) == []


def test_frame_to_its_own_net_id(findings):
    found = findings(*ETHERNET, to("127.0.9.1.2.1"))
    assert "13: frame 'out' goes to the NetID of its own port; another port" in found


def test_net_id_outside_the_plant_is_learned(load_plant):
    result = load_plant(
        *ETHERNET, to("5.5.5.5.1.1"), ("timeout_ms: 50", "timeout_ms: 50, foreign: true"),
        ("from: left/state", "from: {publisher: 5.5.5.5.1.1, id: 4}"),
    )  # fmt: skip
    assert result.findings == ()
    assert result.plant.stations[0].frames[0].destination == "5.5.5.5.1.1"


def test_monitoring(load_plant):
    frame = load_plant(to("127.0.9.2, monitor_interval_ms: 500")).plant.stations[0].frames[0]
    assert (frame.monitor_interval_ms, frame.monitor_ip) == (500, "")
    text = "02:00:00:00:00:01, monitor_interval_ms: 2000, monitor_ip: 10.0.0.2"
    frame = load_plant(*ETHERNET, to(text)).plant.stations[0].frames[0]
    assert (frame.monitor_interval_ms, frame.monitor_ip) == (2000, "10.0.0.2")
    for edits in ([], [to("255.255.255.255, monitor_interval_ms: 0")]):
        assert load_plant(*edits).plant.stations[0].frames[0].monitor_interval_ms == 0


@pytest.mark.parametrize(
    ("edits", "finding"),
    [
        (
            [to("255.255.255.255, monitor_interval_ms: 500")],
            "13: frame 'out' is monitored but goes to a group; monitoring only of a unicast frame",
        ),
        (
            [*ETHERNET, to("multicast, monitor_interval_ms: 500, monitor_ip: 10.0.0.2")],
            "13: frame 'out' is monitored but goes to a group; monitoring only of a unicast frame",
        ),
        (
            [to("tcp://127.0.9.2, monitor_interval_ms: 500"), TCP],
            "13: frame 'out' is monitored but goes to tcp://127.0.9.2 by udp://127.0.9.1; E",
        ),
        (
            [to("127.0.9.2, monitor_interval_ms: 99")],
            "13: monitor_interval_ms is 99; at least 100, or 0 for never",
        ),
        (
            [to("127.0.9.2, monitor_interval_ms: 500, monitor_ip: 127.0.9.2")],
            "13: frame 'out' has a monitor_ip, but its destination is an IP address",
        ),
        (
            [*ETHERNET, to("02:00:00:00:00:01, monitor_ip: 10.0.0.2")],
            "13: frame 'out' has a monitor_ip but no monitor_interval_ms; both or none",
        ),
        *(
            (
                [*ETHERNET, to(f"02:00:00:00:00:01, monitor_interval_ms: 500, monitor_ip: {text}")],
                f"13: monitor_ip is '{text}'; the IPv4 address of one host",
            )
            for text in ("there", "127.0.0.1", "224.0.0.1", "255.255.255.255", "0.0.0.0")
        ),
    ],
)
def test_invalid_monitoring_is_a_finding(findings, edits, finding):
    (only,) = findings(*edits)
    assert only.startswith(finding)
