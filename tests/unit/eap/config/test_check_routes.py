from __future__ import annotations

import pytest

from eap.config.load import load

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
def test_a_route_that_cannot_be_is_one_finding(findings, items, finding):
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


def test_everything_wrong_is_told_at_once(findings):
    found = findings(routes("{to: a}", "{to: right, via: x/y, virtual: 1}", "{mqtt: x}"))
    assert [each.partition(":")[0] for each in found] == ["8", "9", "9", "10", "10"], found


def test_a_station_that_could_not_be_read_is_not_told_again(findings):
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


def test_a_circle_is_named_at_each_route_of_it(warnings):
    assert warnings(
        west=[f"{NORTH}, via: middle/eap0"],
        middle=[f"{NORTH}, via: east/eap0"],
        east=[f"{NORTH}, via: west/eap0"],
    ) == [
        "7: the route to 'north' runs in a circle: west -> middle -> east -> west",
        "12: the route to 'north' runs in a circle: middle -> east -> west -> middle",
        "17: the route to 'north' runs in a circle: east -> west -> middle -> east",
    ]


def test_a_circle_by_a_default_route_is_one_too(warnings):
    found = warnings(west=[f"{NORTH}, via: middle/eap0"], middle=["to: default, via: west/eap0"])
    assert found == ["7: the route to 'north' runs in a circle: west -> middle -> west"]


def test_a_route_that_ends_on_the_way_is_named(warnings):
    assert warnings(west=[f"{NORTH}, via: middle/eap0"]) == [
        "7: the route to 'north' ends at middle, which has none on to it"
    ]


def test_who_learns_nothing_has_no_route_by_a_broker(warnings):
    edit = "name: middle\n", "name: middle\n    learn: false\n"
    routes = {"west": [f"{NORTH}, via: middle/eap0"], "middle": ["mqtt: mqtt://b, network: n"]}
    assert len(warnings(*edit, **routes)) == 1


def test_stations_send_each_other_what_is_for_a_third(warnings):
    found = warnings(west=["to: east, via: middle/eap0"], middle=["to: east, via: west/eap0"])
    assert found == [
        "7: the route to 'east' runs in a circle: west -> middle -> west",
        "12: the route to 'east' runs in a circle: middle -> west -> middle",
    ]
