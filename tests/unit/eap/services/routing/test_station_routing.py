from __future__ import annotations

import asyncio

import pytest
from msgspec.structs import replace

from eap.ams.spec import AccessRule, HopSpec, MqttSpec, RouteSpec, RoutingSpec, TransportKind
from eap.errors import ControlError, EnvironmentalError
from eap.runtime.store import StationStore
from eap.services.routing.station_routes import StationRoutes
from eap.services.routing.station_routing import StationRouting
from tests.support.routing import station

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
        self.routing = StationRouting("left", routes, store, self.access.append)
        self.routing.start()

    def names(self):
        return [route.name for route in self.router.table]


def test_applied_routing_is_in_force_at_once_and_after_a_restart(caplog):
    house = House()
    assert house.routing.applied is None
    changes = ["route mill: removed", "route saw: added", "access rule a: added"]
    assert house.routing.plan(OTHER).changes == changes
    assert asyncio.run(house.routing.apply(OTHER, "1")) == changes
    assert (house.names(), house.access) == (["saw"], [FILE, OTHER])
    again = House()
    assert (again.names(), again.access) == (["saw"], [OTHER])
    assert "station left: routes and access rules are as applied last" in caplog.text


def test_edited_plant_file_replaces_applied_routing(caplog):
    asyncio.run(House().routing.apply(OTHER, "1"))
    edited = House(RoutingSpec())
    assert edited.names() == []
    assert edited.routing.applied is None
    assert "the plant file was edited since routes or access rules were changed" in caplog.text
    caplog.clear()
    assert House().names() == ["mill"]  # nor does it come back with the file as it was
    assert caplog.text == ""


def test_plant_file_equal_to_applied_routing_is_not_logged(caplog):
    asyncio.run(House().routing.apply(OTHER, "1"))
    assert House(OTHER).names() == ["saw"]
    assert caplog.text == ""


def test_a_change_is_taken_back_and_made_again():
    house = House()
    asyncio.run(house.routing.apply(OTHER, "1"))
    assert asyncio.run(house.routing.roll_back()) == [
        "route saw: removed",
        "route mill: added",
        "access rule a: removed",
    ]
    assert house.names() == ["mill"]
    assert house.routing.applied.undone
    asyncio.run(house.routing.roll_back())
    assert House().names() == ["saw"]
    assert not house.routing.applied.undone


def test_steps_of_one_change_are_taken_back_together():
    house = House()
    asyncio.run(house.routing.apply(OTHER, "1"))
    asyncio.run(house.routing.apply(RoutingSpec(), "1"))
    asyncio.run(house.routing.roll_back())
    assert house.names() == ["mill"]


def test_apply_of_the_same_routing_changes_nothing():
    house = House()
    assert asyncio.run(house.routing.apply(FILE, "1")) == []
    assert house.routing.applied is None
    with pytest.raises(ControlError, match="were not changed while the station ran"):
        asyncio.run(house.routing.roll_back())


def test_a_broker_does_not_change_while_it_runs():
    broker = replace(FILE, mqtt=(MqttSpec(network="n", host="broker"),))
    house = House()
    with pytest.raises(ControlError, match="MQTT network n: added: restart the appliance"):
        asyncio.run(house.routing.apply(broker, "1"))
    assert house.routing.plan(broker).refused
    assert house.routing.applied is None


def test_routing_that_cannot_be_stored_is_not_in_force(monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", "/dev/null/x")
    house = House()
    with pytest.raises(EnvironmentalError, match="routes and access rules cannot be kept"):
        asyncio.run(house.routing.apply(OTHER, "1"))
    assert house.names() == ["mill"]
