"""Routes of a station, and their hops from the plant file."""

from __future__ import annotations

import asyncio
import threading

import pytest
from msgspec.structs import replace

from eap.ams.access import AccessList
from eap.ams.routes import Origin, Route, RouteTable
from eap.ams.spec import (
    AccessRule,
    HopSpec,
    MqttSpec,
    Role,
    RouteSpec,
    RoutingSpec,
    TransportKind,
)
from eap.control.protocol import WriteOrigin
from eap.errors import ControlError
from eap.ids import Endpoint, NetId
from eap.runtime.store import StationFile, StationStore
from eap.services.routing import station_routes
from eap.services.routing.station_routes import (
    LEARNED_NS,
    MAX_ADDED,
    StationRoutes,
    access_of,
    denial_of_write,
    make_router,
    to_endpoint,
    to_route,
)
from tests.support.eventually import settle
from tests.support.routing import station
from tests.unit.eap.conftest import eap_port, left

OWN = NetId.parse("10.0.0.1.1.1")
STATIC = RouteSpec(
    name="mill",
    net_id="10.0.0.2.1.1",
    hop=HopSpec(TransportKind.UDP, "eap0", "10.0.0.2:34980"),
    router="10.0.0.2.1.1",
    is_derived=True,
)
PLC = RouteSpec(
    name="plc", net_id="5.1.2.3.1.1", hop=HopSpec(TransportKind.AMS_TCP, "", "plc:48898")
)

WITH_STATIC = RoutingSpec(routes=(STATIC,))


class Router:
    def __init__(self):
        self.table = RouteTable()
        self.net_ids = (OWN,)
        self.add_route = self.table.add
        self.remove_route = self.table.remove


class House:
    """A station with its store, which may start again."""

    def __init__(self, spec=WITH_STATIC):
        self.router = Router()
        self.store = StationStore("demo", "left").routes
        self.routes = StationRoutes(self.router, spec, self.store, open_hop=self.open)
        self.routes.start()

    def open(self, hop):
        if hop.port == "gone":
            raise ValueError("there is no transport udp:gone")
        return Endpoint(f"{hop.kind}:{hop.port}", hop.address)

    def names(self):
        return {route.name: route.origin for route in self.router.table}


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path))


def test_an_added_route_is_there_again_after_a_new_start():
    house = House()
    asyncio.run(house.routes.add(PLC))
    assert house.names() == {"mill": Origin.STATIC, "plc": Origin.ADDED}
    again = House()
    assert again.names() == house.names()
    assert again.routes.added == (PLC,)
    asyncio.run(again.routes.remove("plc"))
    assert House().names() == {"mill": Origin.STATIC}


@pytest.mark.parametrize(
    ("change", "replaces"),
    [
        ({"net_id": "6.1.2.3.1.1"}, ""),
        ({"name": "other"}, ""),
        ({"hop": HopSpec(TransportKind.UDP, "eap0", "10.0.0.9:34980")}, ""),
        ({"name": "other", "net_id": "6.1.2.3.1.1"}, "plc"),
        ({"name": "other", "net_id": "6.1.2.3.1.1"}, "5.1.2.3.1.1"),
    ],
)
def test_added_route_replaces_that_of_its_name_or_net_id(change, replaces):
    house = House()
    asyncio.run(house.routes.add(PLC))
    new = replace(PLC, **change)
    asyncio.run(house.routes.add(new, replaces=replaces))
    assert house.routes.added == (new,)
    assert len(house.router.table) == 2
    assert House().routes.added == (new,)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"name": " \n"}, "a route needs a name"),
        ({"net_id": "1.2.3"}, "'1.2.3' is not an AMS NetID"),
        ({"net_id": "0.0.0.0.0.0"}, "NetID 0.0.0.0.0.0 is the default route; it matches 0 octets"),
        ({"net_id": "10.0.0.1.9.9"}, "NetID 10.0.0.1.x.x belongs to this station"),
        ({"net_id": "10.0.0.2.9.9"}, "route 'mill' of the plant file covers the same NetIDs and"),
        ({"net_id": STATIC.net_id, "octets": 6}, "route 'mill' of the plant file covers the same"),
        ({"octets": 3}, "3 bytes to match, expected 6, 5, 4 or 0"),
        (
            {"hop": HopSpec(TransportKind.UDP, "gone", "1.1.1.1:1")},
            "there is no transport udp:gone",
        ),
    ],
)
def test_impossible_route_changes_nothing(change, reason):
    house = House()
    asyncio.run(house.routes.add(PLC))
    before = list(house.router.table)
    with pytest.raises(ControlError) as caught:
        asyncio.run(house.routes.add(replace(PLC, **{"name": "x", **change})))
    assert reason in str(caught.value)
    assert list(house.router.table) == before
    assert House().routes.added == (PLC,)


def test_a_default_route_can_be_added():
    house = House()
    asyncio.run(house.routes.add(replace(PLC, name="default", net_id="0.0.0.0.0.0", octets=0)))
    assert house.router.table.find(NetId.parse("10.0.0.2.1.1"))[0].name == "mill"
    assert house.router.table.find(NetId.parse("99.0.0.2.1.1"))[0].name == "default"


def test_added_routes_are_limited(monkeypatch):
    house = House()
    asyncio.run(house.routes.add(PLC))
    monkeypatch.setattr("eap.services.routing.station_routes.MAX_ADDED", 1)
    with pytest.raises(ControlError, match="1 routes were added already; remove some"):
        asyncio.run(house.routes.add(replace(PLC, name="b", net_id="6.1.2.3.1.1")))
    asyncio.run(house.routes.add(replace(PLC, name="b")))  # in place of the first
    assert MAX_ADDED > 1


def test_a_name_is_text_that_can_be_shown():
    house = House()
    asyncio.run(house.routes.add(replace(PLC, name=f" a\x1b[2J\n{'b' * 200}")))
    assert house.routes.added[0].name == "a[2J" + "b" * 76


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("mill", "route 'mill' follows from the ports in the plant file; change it there"),
        ("10.0.0.2.1.1", "route 'mill' follows from the ports in the plant file; change it there"),
        ("written", "route 'written' is in the plant file; change it there"),
        ("seen", "route 'seen' is learned: it expires; 'learn: false' prevents it"),
        ("nothing", "no route 'nothing' was added; added routes: plc"),
    ],
)
def test_only_added_routes_are_removed(text, reason):
    written = replace(STATIC, name="written", net_id="7.1.1.1.1.1", is_derived=False)
    house = House(RoutingSpec(routes=(STATIC, written)))
    asyncio.run(house.routes.add(PLC))
    seen = Route(NetId.parse("8.1.1.1.1.1"), "seen", Endpoint("mqtt:n", "8"), Origin.LEARNED)
    house.router.table.add(seen)
    with pytest.raises(ControlError) as caught:
        asyncio.run(house.routes.remove(text))
    assert str(caught.value) == reason
    assert len(house.router.table) == 4


def test_remove_selects_by_transport_and_address():
    house = House()
    asyncio.run(house.routes.add(PLC))
    with pytest.raises(ControlError, match="no route 'plc' was added"):
        asyncio.run(house.routes.remove("plc", address="elsewhere:48898"))
    with pytest.raises(ControlError, match="no route 'plc' was added"):
        asyncio.run(house.routes.remove("plc", transport="udp:eap0"))
    assert asyncio.run(house.routes.remove("plc", transport="ams-tcp:", address="plc:48898")) == PLC


def test_another_plant_file_takes_over_and_added_routes_stay():
    house = House()
    asyncio.run(house.routes.add(PLC))
    other = replace(STATIC, name="saw", net_id="10.0.0.3.1.1", is_derived=False)
    house.routes.replace_spec(RoutingSpec(routes=(other,)))
    assert house.names() == {"saw": Origin.STATIC, "plc": Origin.ADDED}
    assert house.routes.spec.routes == (other,)
    [saw] = [route for route in house.router.table if route.name == "saw"]
    assert not house.routes.is_derived(saw)
    house.routes.replace_spec(RoutingSpec(routes=(replace(PLC, name="written"),)))
    assert house.names() == {"written": Origin.STATIC}
    house.routes.replace_spec(RoutingSpec())
    assert house.names() == {"plc": Origin.ADDED}


def test_a_route_that_stays_is_not_touched():
    """Its connection would be closed and opened again."""
    saw = replace(STATIC, name="saw", net_id="10.0.0.3.1.1")
    house = House(RoutingSpec(routes=(STATIC, saw)))
    touched = []
    house.router.add_route = lambda route: touched.append(route.name)
    house.router.remove_route = lambda net_id, hop: touched.append(str(net_id))
    house.routes.replace_spec(RoutingSpec(routes=(STATIC, replace(saw, timeout_ms=5))))
    assert touched == ["saw"]
    house.routes.replace_spec(RoutingSpec(routes=(STATIC,)))
    assert touched == ["saw", "10.0.0.3.1.1"]


def test_impossible_stored_route_is_logged_and_kept(caplog):
    House().store.save([replace(PLC, hop=HopSpec(TransportKind.UDP, "gone", "1.1.1.1:1"))])
    house = House(
        RoutingSpec(routes=(replace(STATIC, hop=HopSpec(TransportKind.UDP, "gone", "x")),))
    )
    assert house.names() == {}
    assert (
        "route mill of the plant file ignored: route 'mill': there is no transport" in caplog.text
    )
    assert "added route plc ignored" in caplog.text
    house.routes.replace_spec(RoutingSpec())
    assert len(house.routes.added) == 1


def learned(house, net_id="8.1.1.1.1.1", name="seen", now_ns=0):
    return house.routes.learn(NetId.parse(net_id), name, "10.0.0.9", now_ns)


def test_learned_route_expires_after_ten_minutes():
    house = House()
    assert learned(house, name="seen\n")
    [route] = [each for each in house.router.table if each.origin is Origin.LEARNED]
    assert (route.name, route.hop) == ("seen", Endpoint("ams-tcp:10.0.0.9:48898", "10.0.0.9:48898"))
    assert learned(house, now_ns=5)
    assert house.router.table.expire(LEARNED_NS) == []
    assert [each.name for each in house.router.table.expire(LEARNED_NS + 5)] == ["seen"]
    assert House().names() == {"mill": Origin.STATIC}


@pytest.mark.parametrize("net_id", ["10.0.0.1.7.7", "10.0.0.2.7.7", "5.1.2.3.9.9"])
def test_learned_route_does_not_replace_other_routes(net_id):
    house = House()
    asyncio.run(house.routes.add(PLC))
    assert not learned(house, net_id)
    assert len(house.router.table) == 2


def test_nothing_is_learned_where_that_is_switched_off():
    assert not learned(House(RoutingSpec(learn=False)))


def test_learn_sources_decide_which_answers_to_scans_are_learned():
    assert learned(House(RoutingSpec(learn=("mqtt:n", "10.0.0.0/24"))))
    assert not learned(House(RoutingSpec(learn=("mqtt:n", "10.0.1.0/24"))))
    assert not learned(House(RoutingSpec(learn=("mqtt:n",))))
    assert not learned(House(RoutingSpec(learn=())))


def test_learn_accepts_routes_beside_a_default_route():
    house = House()
    asyncio.run(house.routes.add(replace(PLC, name="default", net_id="0.0.0.0.0.0", octets=0)))
    assert learned(house, name="")
    assert house.router.table.find(NetId.parse("8.1.1.1.5.5"))[0].name == "10.0.0.9"


class SlowStore(StationFile):
    """A disk that takes its time; *written* is what came there, in that order."""

    def __init__(self):
        file = StationStore("demo", "left").routes
        super().__init__(file.path.parent, "left", tuple[RouteSpec, ...], "added routes")
        self.go_on = threading.Event()
        self.written = []

    def save(self, value):
        assert self.go_on.wait(10)
        super().save(value)
        self.written.append([each.name for each in value])


def test_changes_wait_for_the_disk_and_packets_do_not():
    house = House()
    house.store = house.routes._store = SlowStore()

    async def script():
        changes = [
            asyncio.ensure_future(house.routes.add(PLC)),
            asyncio.ensure_future(house.routes.add(replace(PLC, name="b", net_id="6.1.2.3.1.1"))),
            asyncio.ensure_future(house.routes.remove("plc")),
        ]
        await settle()
        assert not any(each.done() for each in changes)
        assert house.names() == {"mill": Origin.STATIC}
        changes[0].cancel()  # who asked has gone: what was begun is finished
        house.store.go_on.set()
        await asyncio.wait(changes)

    asyncio.run(script())
    assert house.store.written == [["plc"], ["plc", "b"], ["b"]]
    assert house.names() == House().names() == {"mill": Origin.STATIC, "b": Origin.ADDED}


UDP = HopSpec(TransportKind.UDP, "eap0", "127.0.1.2:34980")
WAY = Endpoint("udp:eap0", "127.0.1.2:34980")
THERE = NetId.parse("5.1.2.3.1.1")


def test_route_has_all_of_its_specification():
    spec = RouteSpec(name="plc", net_id=str(THERE), hop=UDP, timeout_ms=700, router="7.7.7.7.1.1")
    assert to_route(spec, WAY, Origin.ADDED) == Route(
        THERE,
        "plc",
        WAY,
        Origin.ADDED,
        timeout_ns=700_000_000,
        router=NetId.parse("7.7.7.7.1.1"),
    )


def test_virtual_net_id_is_the_one_that_is_known_here():
    spec = RouteSpec(name="plc", net_id=str(THERE), hop=UDP, virtual="6.6.6.6.1.1")
    route = to_route(spec, WAY, Origin.STATIC)
    assert (str(route.net_id), route.real) == ("6.6.6.6.1.1", THERE)


@pytest.mark.parametrize(
    ("hop", "endpoint"),
    [
        (UDP, Endpoint("udp:eap0", "127.0.1.2:34980")),
        (HopSpec(TransportKind.ETHERNET, "eap1", "1.2.3.4.5.6"),
         Endpoint("ethernet:eap1", "1.2.3.4.5.6")),
        (HopSpec(TransportKind.AMS_TCP, "", "10.0.0.5:48898"),
         Endpoint("ams-tcp:10.0.0.5:48898", "10.0.0.5:48898")),
        (HopSpec(TransportKind.MQTT, "line", "1.2.3.4.5.6"), Endpoint("mqtt:line", "1.2.3.4.5.6")),
    ],
)  # fmt: skip
def test_hop_becomes_an_endpoint(hop, endpoint):
    assert to_endpoint(hop) == endpoint


@pytest.mark.parametrize(
    ("kind", "text", "address"),
    [
        (TransportKind.UDP, "10.0.0.5", "10.0.0.5:34980"),
        (TransportKind.TCP, "10.0.0.5:7", "10.0.0.5:7"),
        (TransportKind.ETHERNET, "02-00-00-00-0A-01", "02:00:00:00:0a:01"),
    ],
)
def test_to_endpoint_normalizes_addresses(kind, text, address):
    assert to_endpoint(HopSpec(kind, "eap0", text)).connection == address


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (TransportKind.UDP, "mill"),
        (TransportKind.UDP, "10.0.0.5:0x10"),
        (TransportKind.TCP, "02:00:00:00:00:01"),
        (TransportKind.UDP, "239.1.1.1"),
        (TransportKind.ETHERNET, "10.0.0.5"),
        (TransportKind.ETHERNET, "01:01:05:04:00:00"),
    ],
)
def test_to_endpoint_rejects_invalid_addresses(kind, text):
    with pytest.raises(ValueError, match=r"10\.0|0x10|mill|239|01:01|02:00"):
        to_endpoint(HopSpec(kind, "eap0", text))


def test_addresses_of_the_station_are_this_host():
    station = left(eap_port(1, interface="udp://10.0.0.1"))
    access = access_of(station, RoutingSpec(access=(AccessRule("no", allow=False),)))
    assert access.is_this_host(Endpoint("ams-tcp", "10.0.0.1:4711#1"))
    assert not access.is_this_host(Endpoint("ams-tcp", "10.0.0.2:4711#1"))
    endpoint = Endpoint("ams-tcp", "10.0.0.2:4711#1")
    assert not access.grants(endpoint, THERE, THERE, 1).may_read


def test_unidirectional_network_is_denied_before_other_rules():
    brokers = (
        MqttSpec(network="hall", host="b", is_unidirectional=True),
        MqttSpec(network="line", host="b"),
    )
    access = access_of(left(), RoutingSpec(mqtt=brokers, access=(AccessRule("all"),)))
    granted = [access.grants(Endpoint(transport, "5.1.2.3.1.1"), THERE, THERE, 1).may_read
               for transport in ("mqtt:hall", "mqtt:line")]  # fmt: skip
    assert granted == [False, True]


def test_router_knows_its_net_ids():
    router = make_router(left(), RoutingSpec())
    assert {str(each) for each in router.net_ids} == {"1.1.1.1.1.1", "1.2.3.4.5.1"}


def test_all_addresses_of_the_machine_are_those_of_a_port_at_any(monkeypatch):
    monkeypatch.setattr(station_routes, "own_addresses", lambda: [("eth7", "10.0.0.7")])
    access = access_of(left(eap_port(1, interface="udp://0.0.0.0")), RoutingSpec())
    assert access.is_this_host(Endpoint("ams-tcp", "10.0.0.7:4711#1"))
    assert not access.is_this_host(Endpoint("ams-tcp", "10.0.0.8:4711#1"))


@pytest.mark.parametrize(
    ("origin", "reason"),
    [
        (WriteOrigin("", "10.0.0.5", transport="s7"), ""),
        (WriteOrigin("", "10.0.0.6", transport="s7"), "no rule allows it, and other hosts only"),
        (WriteOrigin("eva", "10.0.0.6", transport="web", role=Role.ENGINEER), ""),
        (WriteOrigin("vera", "10.0.0.5", transport="web", role=Role.VIEWER), "rule viewers"),
        (WriteOrigin("vera", "10.0.0.5", transport="opcua", role=Role.VIEWER), "rule viewers"),
    ],
)
def test_denial_of_write_goes_by_the_role_of_the_user_or_of_the_address(origin, reason):
    rules = (
        AccessRule("panels", roles=(Role.OPERATOR,), members=("10.0.0.5/32",)),
        AccessRule("viewers", allow=False, roles=(Role.VIEWER,)),
    )
    router = station("10.0.0.1.2.1")
    router.set_access(AccessList(rules))
    assert denial_of_write(router, origin).startswith(reason)
    assert bool(denial_of_write(router, origin)) is bool(reason)
