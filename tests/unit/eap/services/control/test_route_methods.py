from __future__ import annotations

from inspect import isawaitable
from ipaddress import IPv4Address
from typing import Any

import pytest
from msgspec.structs import replace

from eap.ams.routes import Origin, Route
from eap.ams.spec import (
    HopSpec,
    MqttSpec,
    RoutingSpec,
    SecureAdsSpec,
    SecureRouteSpec,
    TlsSpec,
    TransportKind,
)
from eap.codec.staticroutes import StaticBroker, StaticRoute, dump, parse
from eap.errors import ControlError, EnvironmentalError
from eap.ids import Endpoint, NetId
from eap.services.control.route_methods import RouteMethods
from eap.services.routing.remote_routers import RemoteRouter
from tests.support.routeviews import DIRECTORY, Left
from tests.support.routing import while_serving
from tests.support.virtualtime import run_virtual

SECURE = SecureAdsSpec(certificate="/own.crt", key="/own.key", ca="/ca.crt")
PLC = {"station": "left", "name": "plc", "net_id": "5.1.2.3.1.1", "via": "ams-tcp:10.0.0.5"}


@pytest.fixture
def left():
    return Left()


@pytest.fixture
def methods(left):
    return RouteMethods({"left": left.view}, DIRECTORY).table()


@pytest.fixture
def ask(methods):
    def ask(method, **params):
        result = methods[f"routes_{method}"](params)
        return run_virtual(result) if isawaitable(result) else result

    return ask


def names(left: Left) -> list[str]:
    return [route.name for route in left.router.table]


def refused(ask: Any, method: str, **params: Any) -> tuple[str, str]:
    with pytest.raises(ControlError) as caught:
        ask(method, **params)
    return caught.value.code, str(caught.value)


def test_list_of_all_and_of_one(ask):
    (row,) = ask("list")
    assert [each.name for each in row.routes] == ["right"]
    assert ask("list", station="left") == [row]
    assert refused(ask, "list", station="lefd") == (
        "unknown_name", "unknown station 'lefd', did you mean left?"
    )  # fmt: skip


def test_add_and_remove(ask, left):
    answer = ask("add", **PLC, octets=6, timeout_ms=900, unidirectional=True, probed=False)
    row = answer.route
    assert (row.name, row.transport, row.address, row.origin) == (
        "plc", "ams-tcp:10.0.0.5:48898", "10.0.0.5:48898", "added"
    )  # fmt: skip
    assert answer.warnings == []
    (route,) = (each for each in left.router.table if each.name == "plc")
    assert (route.origin, route.octets, route.timeout_ns) == (Origin.ADDED, 6, 900_000_000)
    assert (route.is_unidirectional, route.is_probed) == (True, False)
    assert names(Left()) == ["right", "plc"]  # it is kept
    removed = ask("remove", station="left", route="plc").route
    assert (removed.name, removed.net_id, removed.transport) == ("plc", "5.1.2.3.1.1", "ams-tcp")
    assert names(left) == ["right"]


def test_route_of_the_plant_needs_no_net_id(ask, left):
    ask("add", station="left", name="third", via="udp:127.0.9.9", octets=6)
    assert str(left.routes.added[0].net_id) == "127.0.9.3.1.1"
    ask("add", station="left", name="others", via="right/eap0", octets=0)
    assert left.routes.added[1].router == "127.0.9.2.1.1"
    code, text = refused(ask, "add", station="left", name="rigth", via="udp:127.0.9.9")
    assert code == "value"
    assert text == "a NetID is needed: 'rigth' is no station of the plant, did you mean right?"


def test_replaced_route_goes(ask, left):
    ask("add", **PLC)
    ask("add", **(PLC | {"name": "press", "net_id": "5.1.2.4.1.1"}), replaces="plc")
    assert names(left) == ["right", "press"]


def test_add_invalid_route_is_an_error(ask, left):
    net_id = NetId.parse(PLC["net_id"])
    left.router.add_route(Route(net_id, "first", Endpoint("udp:eap0", "127.0.9.9:34980"), octets=6))
    (warning,) = ask("add", **PLC).warnings
    assert warning.startswith("route plc (5.1.2.3.1.1, 10.0.0.5:48898 by ams-tcp)")
    assert "is not taken for 5.1.2.3.1.1: first" in warning


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"net_id": "5.1.2"}, "is not an AMS NetID"),
        ({"via": "nowhere"}, "neither a station of the plant nor one of"),
        ({"via": "ethernet:02:00:00:00:00:09"}, "no EAP port here is on ethernet"),
        ({"net_id": "127.0.9.1.1.1"}, "belongs to this station"),
        ({"net_id": "127.0.9.2.1.1"}, "of the plant file covers the same NetIDs"),
        ({"virtual": "x"}, "is not an AMS NetID"),
        ({"via": "mqtt:line"}, "has no transport mqtt:line"),
    ],
)
def test_routes_that_cannot_be_are_refused(ask, left, change, reason):
    assert reason in refused(ask, "add", **(PLC | change))[1]
    assert names(left) == ["right"]


def test_remove_of_an_unknown_route(ask):
    assert refused(ask, "remove", station="left", route="right")[0] == "refused"
    assert "no route 'x' was added" in refused(ask, "remove", station="left", route="x")[1]


def test_route_that_cannot_be_stored_is_refused(ask, left, monkeypatch):
    def fail(_):
        raise EnvironmentalError("disk full")

    monkeypatch.setattr(left.routes._store, "save", fail)
    assert refused(ask, "add", **PLC) == ("unavailable", "disk full")


def test_virtual_routes_have_their_local_net_ids(ask):
    ask("add", **PLC, virtual="9.9.9.9.1.1")
    removed = ask("remove", station="left", route="9.9.9.9.1.1").route
    assert (removed.net_id, removed.real) == ("9.9.9.9.1.1", "5.1.2.3.1.1")


def test_routes_test_sends_a_request(methods, left):
    testing = methods["routes_test"]({"station": "left", "target": "left", "timeout_ms": 200})
    found = run_virtual(while_serving(testing, left.router))
    assert (found.ok, found.state) == (True, "RUN")


def test_import_adds_valid_routes_and_reports_the_rest(ask, left):
    file = [
        StaticRoute("plc", "5.1.2.3.1.1", "10.0.0.5"),
        StaticRoute("old", "5.1.2.4.1.1", "3", "PROFIBUS"),
        StaticRoute("bare", "5.1.2.5.1.1", ""),
        StaticRoute("wrong", "5.1.2", "10.0.0.6"),
        StaticRoute("self", "127.0.9.1.1.1", "10.0.0.7"),
    ]
    xml = dump("x", "1.1.1.1.1.1", file, tcp_port=48898)
    dry = ask("import", station="left", xml=xml, dry_run=True)
    assert names(left) == ["right"]
    rows = ask("import", station="left", xml=xml)
    assert rows == dry
    assert [(row.name, bool(row.reason)) for row in rows] == [
        ("plc", False), ("old", True), ("bare", True), ("wrong", True), ("self", True)
    ]  # fmt: skip
    assert rows[0].via == "ams-tcp:10.0.0.5"
    assert rows[1].reason == "its type is 'PROFIBUS', expected TCP_IP"
    assert names(left) == ["right", "plc"]
    with pytest.raises(ControlError) as caught:
        ask("import", station="left", xml="<a/>")
    code, text = caught.value.code, str(caught.value)
    assert (code, text) == ("value", "line 1: it begins with 'a', expected TcConfig")


def test_import_keeps_flags_and_timeout_for_an_export(ask, left):
    plc = StaticRoute(
        "plc", "5.1.2.3.1.1", "10.0.0.5", flags="64", timeout="5", is_unidirectional=True
    )
    (row,) = ask("import", station="left", xml=dump("x", "1.1.1.1.1.1", [plc], tcp_port=48898))
    assert (row.reason, row.note) == (
        "",
        "Flags 64 and Timeout 5 kept for an export, without effect",
    )
    (route,) = (each for each in left.router.table if each.name == "plc")
    assert (route.is_unidirectional, route.timeout_ns) == (True, 0)
    assert names(Left()) == ["right", "plc"]  # as it was stored
    assert parse(ask("export", station="left").xml).routes == [plc]


def test_import_does_not_open_a_protected_route_in_clear_text(ask, left):
    xml = dump("x", "1.1.1.1.1.1", [StaticRoute("plc", "5.1.2.3.1.1", "10.0.0.5")], tcp_port=48898)
    xml = xml.replace("</Route>", "<Tls><Ca>ca.crt</Ca><Key>secret-1</Key></Tls></Route>")
    (row,) = ask("import", station="left", xml=xml)
    assert row.reason == (
        "it is protected by Tls: add it with 'eapctl routes add --via ams-tls:10.0.0.5', or with"
        " tls to the plant file"
    )
    assert names(left) == ["right"]


def test_import_adds_a_route_by_an_authority_where_the_station_has_one(ask, left):
    left.routes.replace_spec(RoutingSpec(secure=SECURE))
    xml = dump("x", "1.1.1.1.1.1", [StaticRoute("plc", "5.1.2.3.1.1", "10.0.0.5")], tcp_port=48898)
    xml = xml.replace("</Route>", '<Tls IgnoreCn="true"><Ca>ca.crt</Ca></Tls></Route>')
    (row,) = ask("import", station="left", xml=xml)
    assert (row.reason, row.via) == ("", "ams-tls:10.0.0.5")
    (added,) = left.routes.added
    assert added.hop == HopSpec(TransportKind.AMS_TLS, "", "10.0.0.5:8016")
    assert added.tls == SecureRouteSpec(check_name=False)
    xml = xml.replace("<Ca>ca.crt</Ca>", "")  # self-signed
    assert "protected by Tls" in ask("import", station="left", xml=xml)[0].reason


def test_route_by_secure_ads_needs_a_certificate_and_trust(ask, left):
    tls = PLC | {"via": "ams-tls:10.0.0.5"}
    assert "station left has no certificate for ams-tls" in refused(ask, "add", **tls)[1]
    left.routes.replace_spec(RoutingSpec(secure=replace(SECURE, ca="")))
    assert "needs a fingerprint: secure_ads of left has no ca" in refused(ask, "add", **tls)[1]
    assert "'xy' is no SHA-256" in refused(ask, "add", **tls, fingerprint="xy")[1]
    assert "not for ams-tcp:10.0.0.5" in refused(ask, "add", **PLC, fingerprint="ab" * 32)[1]
    row = ask("add", **tls, fingerprint="ab" * 32).route
    assert row.transport == "ams-tls:10.0.0.5:8016"
    assert left.routes.added[0].tls == SecureRouteSpec(fingerprint=":".join(["AB"] * 32))


def test_import_names_the_plant_file_entry_of_a_broker(ask, left):
    brokers = [
        StaticBroker("broker.hall", 8883, "hall", "me", "ca.crt", "a.crt", has_tls=True),
        StaticBroker("other", 8883, "other", has_psk=True),
        StaticBroker("known", 1883, "line"),
    ]
    xml = dump("x", "1.1.1.1.1.1", (), brokers, tcp_port=48898)
    xml = xml.replace("<Topic>other</Topic>", "<Topic>other</Topic><Psk><Pwd>secret-1</Pwd></Psk>")
    left.routes.replace_spec(RoutingSpec(mqtt=(MqttSpec(network="line", host="known"),)))
    hall, other, known = ask("import", station="left", xml=xml)
    assert (hall.name, hall.via) == ("hall", "mqtt:hall")
    assert hall.reason == (
        'a broker belongs to the plant file: - {mqtt: "mqtts://broker.hall:8883", network: hall,'
        " user: me}; write password_file and tls with ca, certificate and key too"
    )
    assert "pre-shared keys are not supported" in other.reason
    assert "secret-1" not in other.reason
    assert known.reason == ""


def test_export_has_brokers_without_secrets(ask, left):
    tls = TlsSpec(ca="/etc/ca.crt", certificate="/etc/a.crt", key="/etc/a.key")
    hall = MqttSpec(
        network="hall", host="broker.hall", port=8883, user="me", password_file="/etc/pw", tls=tls
    )
    left.routes.replace_spec(RoutingSpec(mqtt=(hall,)))
    found = ask("export", station="left")
    assert "a.key" not in found.xml
    assert "/etc/pw" not in found.xml
    assert parse(found.xml).brokers == [
        StaticBroker(
            "broker.hall", 8883, "hall", "me", "/etc/ca.crt", "/etc/a.crt", has_tls=True
        )
    ]  # fmt: skip


def test_export_holds_ams_tcp_and_names_the_rest(ask):
    ask("add", **PLC)
    ask("add", **(PLC | {"name": "behind", "net_id": "5.1.2.4.1.1", "via": "ams-tcp:plc:1000"}))
    ask("add", **(PLC | {"name": "nat", "net_id": "5.1.2.5.1.1", "virtual": "9.9.9.9.1.1"}))
    found = ask("export", station="left")
    assert found.left_out == ["right", "nat"]
    assert parse(found.xml).routes == [
        StaticRoute("plc", "5.1.2.3.1.1", "10.0.0.5"),
        StaticRoute("behind", "5.1.2.4.1.1", "plc:1000"),
    ]
    assert ask("import", station="left", xml=found.xml)[1].reason == ""


class NeighbourScanner:
    """Finds two routers, one of them is known."""

    def __init__(self):
        self.asked = []

    async def scan(self, address="", *, wait_s):
        self.asked.append((address, wait_s))
        return [
            RemoteRouter("right", NetId.parse("127.0.9.2.1.1"), "127.0.9.2", "1.2.3"),
            RemoteRouter("cx", NetId.parse("5.1.2.3.1.1"), "10.0.0.5", ""),
        ]


def test_scan_lists_routers_and_learns_routes(ask, left):
    left.routes.scanners.append(scanner := NeighbourScanner())
    known, new = ask("scan", station="left", address="10.0.0.255", wait_ms=20)
    assert scanner.asked == [("10.0.0.255", 0.02)]
    assert (known.name, known.route, known.is_learned) == ("right", "right", False)
    assert (new.station, new.net_id, new.address) == ("left", "5.1.2.3.1.1", "10.0.0.5")
    assert (new.route, new.is_learned) == ("cx", True)
    assert ask("scan")[1].is_learned  # again, which makes it younger


def test_scan_from_a_default_route_knows_no_route(ask, left):
    left.routes.scanners.append(NeighbourScanner())
    ask("add", station="left", name="others", via="right/eap0", octets=0)
    row = ask("scan")[1]
    assert (row.route, row.is_learned) == ("cx", True)


def test_scan_that_cannot_be(ask):
    assert ask("scan") == []  # nobody here has an address
    for params, code, text in (
        ({"station": "left"}, "unavailable", "no IP address at which it serves AMS"),
        ({"address": "plc"}, "value", "address: Expected 4 octets in 'plc'"),
    ):
        with pytest.raises(ControlError, match=text) as caught:
            ask("scan", **params)
        assert caught.value.code == code


class Introducer:
    """Stands for another router that is asked for a route."""

    address = IPv4Address("127.0.9.1")

    def __init__(self, result):
        self.result = result
        self.asked = []

    async def add_remote_route(self, wanted, address, *, wait_s):
        self.asked.append((*wanted, address, wait_s))
        return self.result


@pytest.mark.parametrize(
    ("result", "ok", "text"),
    [
        (0, True, "added"),
        (
            0x704,
            False,
            "error 0x704 (not permitted: read only, protected, or a wrong user or password)",
        ),
        (None, False, "no answer by UDP 48899"),
    ],
)
def test_add_remote_requests_a_route_from_another_router(ask, left, result, ok, text):
    left.routes.scanners.append(other := Introducer(result))
    login = {"user": "Administrator", "password": "1"}
    row = ask("add_remote", station="left", address="10.0.0.5", **login, wait_ms=20)
    assert (row.ok, row.result, row.text) == (ok, result, text)
    net_id = NetId.parse("127.0.9.1.1.1")
    assert other.asked == [("left", net_id, "Administrator", "1", "10.0.0.5", 0.02)]


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({"address": "plc"}, "address: Expected 4 octets in 'plc'"),
        ({"address": "10.0.0.5", "user": "a\0"}, "NUL in name, user or password"),
        ({"address": "10.0.0.5"}, "no IP address at which it serves AMS"),
    ],
)
def test_introduction_that_cannot_be(ask, params, text):
    with pytest.raises(ControlError, match=text):
        ask("add_remote", station="left", **params)
