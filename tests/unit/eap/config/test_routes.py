from __future__ import annotations

import pytest

from eap.ams.spec import HopSpec, TransportKind
from eap.config.load import load
from eap.config.routes import (
    SectionError,
    find_hop,
    net_ids_of,
    next_hop,
    prefixes,
    route_net_ids,
    stations_without_prefix,
    target_of,
)
from eap.config.structs import RouteSection as Route

RIGHT = "127.0.9.2.1.1"
LEFT_PORT = '- {name: eap0, kind: eap, interface: "udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
RIGHT_PORT = '- {name: eap0, kind: eap, interface: "udp://127.0.9.2", net_id: 127.0.9.2.2.1}'
MORE = (
    LEFT_PORT,
    (
        f"{LEFT_PORT}\n"
        '      - {name: eth0, kind: eap, interface: "ethernet://eth0", net_id: 127.0.9.1.4.1}\n'
        '      - {name: far, kind: eap, interface: "udp://10.0.0.1", net_id: 127.0.9.1.5.1}\n'
        '      - {name: bus0, kind: bus, interface: "ethernet://eth9", net_id: 127.0.9.1.3.1}\n'
        "    routes: [{mqtt: mqtt://a, network: plant}, {mqtt: mqtt://b, network: alone}]"
    ),
)
THEIRS = RIGHT_PORT, f"{RIGHT_PORT}\n    routes: [{{mqtt: mqtt://a, network: plant}}]"


@pytest.fixture
def follow(index):
    """Return the next hop of a route of the left station."""

    def of(route):
        plant = index(MORE, THEIRS)
        return next_hop(plant, plant.stations["left"], route)

    return of


@pytest.mark.parametrize(
    ("route", "hop", "router"),
    [
        (Route(to="right"), (TransportKind.UDP, "eap0", "127.0.9.2:34980"), RIGHT),
        (Route(to="right", port="eap0"), (TransportKind.UDP, "eap0", "127.0.9.2:34980"), RIGHT),
        (Route(to="x", via="right/eap0"), (TransportKind.UDP, "eap0", "127.0.9.2:34980"), RIGHT),
        (Route(to="x", via="10.0.0.9"), (TransportKind.UDP, "far", "10.0.0.9:34980"), ""),
        (Route(to="x", via="10.0.0.9:1"), (TransportKind.UDP, "far", "10.0.0.9:1"), ""),
        (Route(to="x", via="10.0.0.9", port="eap0"),
         (TransportKind.UDP, "eap0", "10.0.0.9:34980"), ""),
        (Route(to="x", via="tcp://127.0.0.9"), (TransportKind.TCP, "eap0", "127.0.0.9:34980"), ""),
        (Route(to="x", via="02-00-00-00-00-0A"),
         (TransportKind.ETHERNET, "eth0", "02:00:00:00:00:0a"),
         ""),
        (Route(to="x", via="5.1.2.3.1.1"), (TransportKind.ETHERNET, "eth0", "5.1.2.3.1.1"), ""),
        (Route(to="right", via="127.0.9.2"), (TransportKind.UDP, "eap0", "127.0.9.2:34980"), RIGHT),
        (Route(to="x", ams_tcp="plc"), (TransportKind.AMS_TCP, "", "plc:48898"), ""),
        (Route(to="right", ams_tcp="h:1"), (TransportKind.AMS_TCP, "", "h:1"), RIGHT),
        (Route(to="x", ams_tcp="right/eap0"),
         (TransportKind.AMS_TCP, "", "127.0.9.2:48898"), RIGHT),
        (Route(to="right", via="mqtt:plant"), (TransportKind.MQTT, "plant", RIGHT), RIGHT),
        (Route(to="default", via="mqtt:plant/right"), (TransportKind.MQTT, "plant", RIGHT), RIGHT),
        (Route(to="x", net_id="5.1.2.3.1.1", via="mqtt:alone"),
         (TransportKind.MQTT, "alone", "5.1.2.3.1.1"), "5.1.2.3.1.1"),
    ],
)  # fmt: skip
def test_a_route_leads_to_its_next_hop(follow, route, hop, router):
    assert follow(route) == (HopSpec(*hop), router)


@pytest.mark.parametrize(
    ("route", "key", "message"),
    [
        (Route(to="x"), "", "route 'x' has no via and no ams_tcp"),
        (Route(to="right", port="far"), "to", "left and right share no interface"),
        (Route(to="x", via="a/b", ams_tcp="h"), "via", "route 'x' has via and ams_tcp"),
        (
            Route(to="x", ams_tcp="h", port="eap0"),
            "port",
            "route 'x' leaves by no port of its own",
        ),
        (
            Route(to="x", via="mqtt:plant", port="eap0"),
            "port",
            "route 'x' leaves by no port of it",
        ),
        (
            Route(to="x", via="1.1.1.1", port="eap9"),
            "port",
            "station left has no EAP port 'eap9', ",
        ),
        (
            Route(to="x", via="1.1.1.1", port="bus0"),
            "port",
            "station left has no EAP port 'bus0'",
        ),
        (
            Route(to="x", via="1.1.1.1", port="eth0"),
            "via",
            "1.1.1.1 cannot be reached from port e",
        ),
        (
            Route(to="x", via="rigth/eap0"),
            "via",
            "no station 'rigth' in this plant, did you mean",
        ),
        (Route(to="x", via="left/eap0"), "via", "left/eap0 is of station left itself"),
        (Route(to="x", via="right/eap7"), "via", "station right has no EAP port 'eap7'"),
        (
            Route(to="x", via="right/eap0", port="eth0"),
            "via",
            "right/eap0 cannot be reached from ",
        ),
        (
            Route(to="x", via="right/eap0", port="far"),
            "via",
            "right/eap0 cannot be reached from p",
        ),
        (Route(to="x", via="what"), "via", "via: 'what' is not an IPv4 address"),
        (Route(to="x", via="239.1.1.1"), "via", "239.1.1.1 is a group"),
        (
            Route(to="x", ams_tcp="1.2.3"),
            "ams_tcp",
            "ams_tcp: '1.2.3' is not the IPv4 address",
        ),
        (Route(to="x", ams_tcp="right/no"), "ams_tcp", "station right has no EAP port 'no'"),
        (Route(to="x", via="mqtt:what"), "via", "station left is in no MQTT network 'what'"),
        (Route(to="x", via="mqtt:plant/who"), "via", "no station 'who' in this plant"),
        (
            Route(to="right", via="mqtt:alone"),
            "via",
            "station right is in no MQTT network 'alone'",
        ),
        (
            Route(to="default", via="mqtt:plant"),
            "via",
            "route 'default' does not say which router",
        ),
    ],
)
def test_unreachable_next_hop_is_refused_with_the_reason(follow, route, key, message):
    with pytest.raises(SectionError) as caught:
        follow(route)
    assert caught.value.key == key
    assert str(caught.value).startswith(message)


def test_ams_tcp_is_where_a_port_serves_it(index):
    plant = index((RIGHT_PORT, RIGHT_PORT.replace("}", ", ams: false}")))
    with pytest.raises(SectionError, match="right/eap0 does not serve AMS/TCP"):
        next_hop(plant, plant.stations["left"], Route(to="x", ams_tcp="right/eap0"))


def test_of_several_ethernet_interfaces_one_has_to_be_named(index):
    ports = LEFT_PORT.replace("udp://127.0.9.1", "ethernet://a")
    ports += (
        f"\n      {ports}".replace("eap0", "eap1").replace("//a", "//b").replace("2.1}", "9.1}")
    )
    plant = index((LEFT_PORT, ports))
    with pytest.raises(SectionError, match="does not say by which Ethernet interface"):
        next_hop(plant, plant.stations["left"], Route(to="x", via="5.1.2.3.1.1"))


def test_a_default_route_leads_to_no_station(index):
    plant = index(("name: right", "name: default"))
    assert target_of(plant, Route(to="default")) is None
    assert target_of(plant, Route(to="left")) is plant.stations["left"]


def test_a_station_whose_net_ids_begin_alike_is_reached_by_four_octets(index):
    plant = index()
    assert stations_without_prefix(plant) == set()
    assert net_ids_of(plant.stations["left"], set()) == [("127.0.9.1.1.1", 4)]


@pytest.mark.parametrize(
    ("old", "new", "shared"),
    [
        ("net_id: 127.0.9.2.1.1", "net_id: 5.5.5.5.1.1", {"right"}),
        ("net_id: 127.0.9.1.2.1", "net_id: 127.0.9.2.9.9", {"left", "right"}),
    ],
)
def test_others_are_reached_by_each_of_their_net_ids(index, old, new, shared):
    plant = index((old, new))
    assert stations_without_prefix(plant) == shared
    found = net_ids_of(plant.stations["right"], shared)
    assert [octets for _, octets in found] == [6, 6]
    assert found[1][0] == "127.0.9.2.2.1"


def test_net_ids_that_are_none_are_passed_over(index):
    plant = index(("net_id: 127.0.9.2.1.1", "net_id: what"))
    assert prefixes(plant.stations["right"]) == {bytes((127, 0, 9, 2))}


@pytest.mark.parametrize(
    ("route", "found"),
    [
        (Route(to="default"), [("0.0.0.0.0.0", 0)]),
        (Route(to="plc", net_id="5.1.2.3.1.1"), [("5.1.2.3.1.1", 4)]),
        (Route(to="plc", net_id="5.1.2.3.1.1", octets=6), [("5.1.2.3.1.1", 6)]),
        (Route(to="left"), [("127.0.9.1.1.1", 6), ("127.0.9.1.2.1", 6)]),
        (Route(to="left", virtual="9.9.9.9.1.1"), [("127.0.9.1.1.1", 4)]),
    ],
)
def test_a_route_is_for_the_net_ids_of_its_target(index, route, found):
    assert route_net_ids(index(), route, {"left"}) == found


LEFT = '{name: eap0, kind: eap, interface: "udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
RIGHT_SIDE = '{name: eap0, kind: eap, interface: "udp://127.0.9.2", net_id: 127.0.9.2.2.1}'


def port(name, uri, net_id, more=""):
    return f'{{name: {name}, kind: eap, interface: "{uri}", net_id: {net_id}{more}}}'


def left(*uris, more=""):
    ports = [port(f"eap{n}", uri, f"127.0.9.1.2.{n + 1}", more) for n, uri in enumerate(uris)]
    return LEFT, "\n      - ".join(ports)


def right(*uris, more=""):
    ports = [port(f"eap{n}", uri, f"127.0.9.2.2.{n + 1}", more) for n, uri in enumerate(uris)]
    return RIGHT_SIDE, "\n      - ".join(ports)


@pytest.fixture
def hop(index):
    def of(*edits, **wanted):
        plant = index(*edits)
        return find_hop(plant, plant.stations["left"], plant.stations["right"], **wanted)

    return of


def test_udp_ports_reach_each_other_at_their_addresses(hop):
    assert hop() == HopSpec(TransportKind.UDP, "eap0", "127.0.9.2:34980")
    assert hop(right("udp://127.0.9.2:40000")).address == "127.0.9.2:40000"


@pytest.mark.parametrize(
    ("mine", "theirs"),
    [("udp", "tcp"), ("tcp", "udp"), ("tcp", "tcp")],
)
def test_hop_without_udp_is_a_tcp_connection(hop, mine, theirs):
    found = hop(left(f"{mine}://127.0.9.1"), right(f"{theirs}://127.0.9.2"))
    assert found == HopSpec(TransportKind.TCP, "eap0", "127.0.9.2:34980")


def test_on_ethernet_a_port_is_its_mac_address_or_its_net_id(hop):
    line = left("ethernet://eth0")
    by_net_id = hop(line, right("ethernet://eth0"))
    assert by_net_id == HopSpec(TransportKind.ETHERNET, "eap0", "127.0.9.2.2.1")
    by_mac = hop(line, right("ethernet://eth0", more=", mac: 02-00-00-00-00-0A"))
    assert by_mac.address == "02:00:00:00:00:0a"


@pytest.mark.parametrize(
    ("mine", "theirs", "more"),
    [
        ("ethernet://eth0", "ethernet://eth1", ""),
        ("ethernet://eth0", "ethernet://eth0", ", vlan: {id: 3}"),
        ("ethernet://eth0", "udp://127.0.9.2", ""),
        ("loop://line", "loop://line", ""),
        ("udp://10.0.0.1", "udp://127.0.9.2", ""),
        ("udp://127.0.9.1", "udp://0.0.0.0", ""),
    ],
)
def test_stations_without_shared_interface_have_no_hop(hop, mine, theirs, more):
    assert hop(left(mine), right(theirs, more=more)) is None


def test_named_port_of_another_interface_counts_as_shared(hop):
    found = hop(left("ethernet://eth0"), right("ethernet://eth1"), other="eap0")
    assert found == HopSpec(TransportKind.ETHERNET, "eap0", "127.0.9.2.2.1")


def test_hop_prefers_udp_and_the_same_network(hop):
    both = [left("udp://10.1.0.1", "udp://10.2.0.1"), right("udp://10.2.0.2", "udp://10.3.0.2")]
    assert hop(*both) == HopSpec(TransportKind.UDP, "eap1", "10.2.0.2:34980")
    mixed = [left("ethernet://eth0", "udp://10.2.0.1"), right("ethernet://eth0", "udp://10.9.0.2")]
    assert hop(*mixed) == HopSpec(TransportKind.UDP, "eap1", "10.9.0.2:34980")


def test_a_port_that_is_named_is_the_only_one_that_counts(hop):
    both = [left("udp://10.1.0.1", "udp://10.2.0.1"), right("udp://10.2.0.2", "udp://10.3.0.2")]
    assert hop(*both, own="eap0").port == "eap0"
    assert hop(*both, other="eap1").address == "10.3.0.2:34980"
    assert hop(*both, other="eap9") is None


PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
THIRD = """
  - name: third
    net_id: 127.0.9.3.1.1
    ports:
      - {name: eap0, kind: eap, interface: "loop://x", net_id: 127.0.9.3.2.1}
"""
LAST = "variables: {a: REAL, b: UDINT}}\n"


def routes(*items):
    lines = "".join(f"\n      - {item}" for item in items)
    return PORT, f"{PORT}\n    routes:{lines}"


PLC = "to: plc, net_id: 5.1.2.3.1.1, ams_tcp: plc"


@pytest.mark.parametrize(
    ("items", "finding"),
    [
        (["{via: right/eap0}"], "8: route has neither to nor mqtt; to: STATION, or mqtt: URL"),
        (["{to: left}"], "8: route of left to itself; another station"),
        (["{to: rihgt}"], "8: no station 'rihgt' in this plant, did you mean right?, and no net"),
        (["{to: third}"], "8: left and third share no interface; via: a station between them, or"),
        (["{to: third, via: left/eap0}"], "8: left/eap0 is of station left itself; a port of ano"),
        (["{to: right, net_id: 1.1.1.1.1.1}"], "8: right is a station of this plant, it needs no"),
        (["{to: default, via: right/eap0, net_id: 1.1.1.1.1.1}"], "8: a default route needs no ne"),
        (["{to: right, octets: 5}"], "8: octets of the route to 'right'; it with a net_id"),
        ([f"{{{PLC}, octets: 3}}"], "8: octets is 3; a whole number from 4 to 6"),
        (["{to: plc, net_id: 5.1.2.3, ams_tcp: plc}"], "8: net_id: '5.1.2.3' is not an AMS NetID"),
        (["{to: plc, net_id: 0.0.0.0.0.0, ams_tcp: plc}"], "8: net_id: '0.0.0.0.0.0' is not an A"),
        (["{to: plc, net_id: 5.1.2.3.1.1, ams_tcp: a/b}"], "8: no station 'a' in this plant; one "),
        (["{to: plc, net_id: 5.1.2.3.1.1, ams_tcp: 'a b'}"], "8: ams_tcp: 'a b' is no name of a h"),
        (["{to: right, virtual: 1.2}"], "8: virtual: '1.2' is not an AMS NetID of a station; six"),
        (["{to: default, via: right/eap0, virtual: 1.1.1.1.1.1}"], "8: a default route has no vir"),
        (["{to: right, timeout_ms: 600001}"], "8: timeout_ms is 600001; a whole number of milli"),
        (["{to: right, qos: 1}"], "8: qos does not belong to a route without mqtt; one of to, via"),
        (["{mqtt: mqtt://b, network: n, to: right}"], "8: to does not belong to a broker; one of "),
        (["{to: right}", "{to: right, timeout_ms: 9}"], "9: a second route to 'right' (first in l"),
        (["{to: default, via: right/eap0}", "{to: default, via: 127.0.0.9}"], "9: a second route "),
        ([f"{{{PLC}}}", "{to: b, net_id: 5.1.2.3.9.9, ams_tcp: b}"],
         "9: the route to 'plc' (line 8) is for the same NetIDs; other NetIDs, or octets: 5 or 6"),
        ([f"{{{PLC}}}", "{to: right, virtual: 5.1.2.3.1.1}"],
         "9: the route to 'plc' (line 8) is for the same NetIDs"),
        (["{to: x, net_id: 127.0.9.2.9.9, ams_tcp: x}"], "8: NetID 127.0.9.2.x.x is one of statio"),
        (["{to: x, net_id: 127.0.9.1.9.9, ams_tcp: x}"], "8: NetID 127.0.9.1.x.x is one of this "),
        (["{to: x, net_id: 127.0.9.2.2.1, octets: 6, ams_tcp: x}"], "8: NetID 127.0.9.2.2.1 is on"),
        (["{to: right, virtual: 127.0.9.3.9.9}"], "8: NetID 127.0.9.3.x.x is one of station thir"),
    ],
)  # fmt: skip
def test_invalid_route_is_one_finding(findings, items, finding):
    [found] = findings(routes(*items), (LAST, LAST + THIRD))
    assert found.startswith(finding)


@pytest.mark.parametrize(
    "items",
    [
        [f"{{{PLC}, octets: 6}}", "{to: b, net_id: 5.1.2.3.9.9, ams_tcp: b, octets: 6}"],
        [f"{{{PLC}}}", "{to: b, net_id: 5.1.2.3.9.9, ams_tcp: b, octets: 6}"],
        ["{to: x, net_id: 127.0.9.2.9.9, octets: 6, ams_tcp: x}"],
        ["{to: twin, net_id: 127.0.9.2.2.1, virtual: 9.9.9.9.1.1, ams_tcp: x}"],
        ["{to: right}", "{to: third, via: right/eap0}", "{to: default, via: right/eap0}"],
        ["{mqtt: mqtt://b, network: n}", "{to: default, via: mqtt:n, net_id: 5.1.2.3.1.1}"],
    ],
)
def test_routes_that_can_be_are_no_findings(findings, items):
    assert findings(routes(*items), (LAST, LAST + THIRD)) == []


def test_all_errors_are_reported_at_once(findings):
    found = findings(routes("{to: a}", "{to: right, via: x/y, virtual: 1}", "{mqtt: x}"))
    assert [each.partition(":")[0] for each in found] == ["8", "9", "9", "10", "10"], found


def test_unreadable_station_is_reported_once(findings):
    found = findings(
        routes("{to: third}"), (LAST, LAST + THIRD.replace("net_id: 127.0.9.3.1", "x: 1"))
    )
    assert not any("third' in this plant" in each for each in found)


NAMES = ("west", "middle", "east")
NORTH = "to: north, net_id: 9.9.9.9.1.1"


def plant(routes):
    text = "plant: chain\nstations:\n"
    for number, name in enumerate(NAMES, 1):
        uri, net_id = f"udp://127.0.9.{number}", f"127.0.9.{number}"
        port = f'{{name: eap0, kind: eap, interface: "{uri}", net_id: {net_id}.2.1}}'
        text += f"  - name: {name}\n    net_id: {net_id}.1.1\n    ports: [{port}]\n"
        items = "".join(f"      - {{{item}}}\n" for item in routes.get(name, ()))
        text += f"    routes:\n{items}" if items else ""
    return text


@pytest.fixture
def warnings(tmp_path):
    def of(*edit, **routes):
        path = tmp_path / "plant.yaml"
        path.write_text(plant(routes).replace(*edit) if edit else plant(routes))
        result = load(path, lambda file: ())
        assert result.findings == ()
        return [f"{each.line}: {each.message}" for each in result.warnings]

    return of


@pytest.mark.parametrize(
    "routes",
    [
        {},
        {"west": ["to: east, via: middle/eap0"]},
        {"west": [f"{NORTH}, via: middle/eap0"], "middle": [f"{NORTH}, ams_tcp: north"]},
        {"west": [f"{NORTH}, via: middle/eap0"], "middle": ["to: default, via: 127.0.9.77"]},
        {"west": [f"{NORTH}, via: 127.0.9.77"]},
        {"west": ["to: default, via: middle/eap0"]},
        {"west": [f"{NORTH}, via: middle/eap0"], "middle": ["mqtt: mqtt://b, network: n, user: a"]},
        {"west": ["to: north, net_id: 9.9.9.9.1.1, virtual: 8.8.8.8.1.1, via: middle/eap0"],
         "middle": [f"{NORTH}, ams_tcp: north"]},
    ],
)  # fmt: skip
def test_routes_that_get_there_or_may_do_so_are_no_warning(warnings, routes):
    assert warnings(**routes) == []


def test_route_loop_is_reported_at_each_route(warnings):
    assert warnings(
        west=[f"{NORTH}, via: middle/eap0"],
        middle=[f"{NORTH}, via: east/eap0"],
        east=[f"{NORTH}, via: west/eap0"],
    ) == [
        "7: the route to 'north' runs in a loop: west -> middle -> east -> west",
        "12: the route to 'north' runs in a loop: middle -> east -> west -> middle",
        "17: the route to 'north' runs in a loop: east -> west -> middle -> east",
    ]


def test_loop_by_default_route_is_reported(warnings):
    found = warnings(west=[f"{NORTH}, via: middle/eap0"], middle=["to: default, via: west/eap0"])
    assert found == ["7: the route to 'north' runs in a loop: west -> middle -> west"]


def test_route_that_ends_before_its_target_is_reported(warnings):
    assert warnings(west=[f"{NORTH}, via: middle/eap0"]) == [
        "7: the route to 'north' ends at middle, which has no route to it"
    ]


def test_station_without_learning_has_no_route_by_a_broker(warnings):
    edit = "name: middle\n", "name: middle\n    learn: false\n"
    routes = {"west": [f"{NORTH}, via: middle/eap0"], "middle": ["mqtt: mqtt://b, network: n"]}
    assert len(warnings(*edit, **routes)) == 1


def test_stations_send_each_other_what_is_for_a_third(warnings):
    found = warnings(west=["to: east, via: middle/eap0"], middle=["to: east, via: west/eap0"])
    assert found == [
        "7: the route to 'east' runs in a loop: west -> middle -> west",
        "12: the route to 'east' runs in a loop: middle -> west -> middle",
    ]
