from __future__ import annotations

import pytest

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
