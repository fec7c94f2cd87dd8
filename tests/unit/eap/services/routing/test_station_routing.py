from __future__ import annotations

import asyncio

import pytest
from msgspec.structs import replace

from eap.ams.routes import Origin, Route
from eap.ams.spec import AccessRule, HopSpec, MqttSpec, RouteSpec, RoutingSpec, TransportKind
from eap.errors import ControlError, EnvironmentalError
from eap.ids import Endpoint, NetId
from eap.runtime.store import StationStore
from eap.services.routing.station_routes import StationRoutes
from eap.services.routing.station_routing import StationRouting
from eap.services.transports.station_brokers import StationBrokers
from tests.support.routing import station
from tests.support.virtualtime import run_virtual

HOP = HopSpec(TransportKind.UDP, "eap0", "10.0.0.2:34980")
MILL = RouteSpec(name="mill", net_id="10.0.0.2.1.1", hop=HOP)
SAW = RouteSpec(name="saw", net_id="10.0.0.3.1.1", hop=HOP)
FILE = RoutingSpec(routes=(MILL,))
OTHER = RoutingSpec(routes=(SAW,), access=(AccessRule("a"),))


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path / "state"))


class House:
    """A station that may start again, with another plant file."""

    def __init__(self, told=FILE):
        self.access = []
        self.router = station("10.0.0.1.2.1")
        routes = StationRoutes(self.router, told, StationStore("p", "left").routes)
        store = StationStore("p", "left").routing
        self.brokers = StationBrokers(self.router)
        self.routing = StationRouting("left", routes, store, self.access.append, self.brokers)
        self.routing.start()

    def names(self):
        return [route.name for route in self.router.table]


def test_applied_routing_is_in_force_at_once_and_after_a_restart(caplog):
    house = House()
    assert house.routing.applied is None
    changes = ["route mill: removed", "route saw: added", "access rule a: added"]
    assert house.routing.plan(OTHER).changes == changes
    assert run_virtual(house.routing.apply(OTHER, "1")) == changes
    assert (house.names(), house.access) == (["saw"], [FILE, OTHER])
    again = House()
    assert (again.names(), again.access) == (["saw"], [OTHER])
    assert "station left: routes and access rules are as applied last" in caplog.text


def test_edited_plant_file_replaces_applied_routing(caplog):
    run_virtual(House().routing.apply(OTHER, "1"))
    edited = House(RoutingSpec())
    assert edited.names() == []
    assert edited.routing.applied is None
    assert "the plant file was edited since routes or access rules were changed" in caplog.text
    caplog.clear()
    assert House().names() == ["mill"]  # nor does it come back with the file as it was
    assert caplog.text == ""


def test_plant_file_equal_to_applied_routing_is_not_logged(caplog):
    run_virtual(House().routing.apply(OTHER, "1"))
    assert House(OTHER).names() == ["saw"]
    assert caplog.text == ""


def test_a_change_is_taken_back_and_made_again():
    house = House()
    run_virtual(house.routing.apply(OTHER, "1"))
    assert run_virtual(house.routing.roll_back()) == [
        "route saw: removed",
        "route mill: added",
        "access rule a: removed",
    ]
    assert house.names() == ["mill"]
    assert house.routing.applied.undone
    run_virtual(house.routing.roll_back())
    assert House().names() == ["saw"]
    assert not house.routing.applied.undone


def test_steps_of_one_change_are_taken_back_together():
    house = House()
    run_virtual(house.routing.apply(OTHER, "1"))
    run_virtual(house.routing.apply(RoutingSpec(), "1"))
    run_virtual(house.routing.roll_back())
    assert house.names() == ["mill"]


def test_apply_of_the_same_routing_changes_nothing():
    house = House()
    assert run_virtual(house.routing.apply(FILE, "1")) == []
    assert house.routing.applied is None
    with pytest.raises(ControlError, match="were not changed while the station ran"):
        run_virtual(house.routing.roll_back())


BROKER = MqttSpec(network="n", host="127.0.0.1", port=1)


def test_brokers_come_change_and_go_while_the_station_runs():
    pytest.importorskip("aiomqtt")
    house = House()

    def networks():
        return [name for name in house.router._senders if name.startswith("mqtt:")]

    async def script():
        serving = asyncio.ensure_future(house.brokers.serve())
        await asyncio.sleep(0)
        assert await house.routing.apply(replace(FILE, mqtt=(BROKER,)), "1") == [
            "MQTT network n: added"
        ]
        assert networks() == ["mqtt:n"]
        house.router.add_route(learned(house.routing))
        other = replace(BROKER, host="127.0.0.2")
        changed = replace(FILE, mqtt=(other, replace(other, network="m")))
        assert await house.routing.apply(changed, "2") == [
            "MQTT network n: changed",
            "MQTT network m: added",
        ]
        assert house.names() == ["mill"]  # what the broker before taught is forgotten
        assert networks() == ["mqtt:n", "mqtt:m"]
        assert house.access[-1] == changed
        assert await house.routing.roll_back() == [
            "MQTT network m: removed",
            "MQTT network n: changed",
        ]
        assert networks() == ["mqtt:n"]
        serving.cancel()
        await asyncio.wait([serving])

    run_virtual(script())
    assert House().routing.routes.spec.mqtt == (BROKER,)


def learned(routing):
    net_id = NetId.parse("9.9.9.9.1.1")
    return Route(net_id, "far", Endpoint("mqtt:n", str(net_id)), Origin.LEARNED)


def test_broker_without_mqtt_installed_is_refused(monkeypatch):
    def missing():
        raise EnvironmentalError("MQTT needs aiomqtt")

    monkeypatch.setattr("eap.net.mqtt.require_mqtt", missing)
    house = House()
    spec = replace(FILE, mqtt=(BROKER,))
    assert house.routing.plan(spec).refused == ["MQTT needs aiomqtt"]
    with pytest.raises(ControlError, match="MQTT needs aiomqtt"):
        run_virtual(house.routing.apply(spec, "1"))
    assert house.routing.applied is None


def test_routing_that_cannot_be_stored_is_not_in_force(monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", "/dev/null/x")
    house = House()
    with pytest.raises(EnvironmentalError, match="routes and access rules cannot be kept"):
        run_virtual(house.routing.apply(OTHER, "1"))
    assert house.names() == ["mill"]
