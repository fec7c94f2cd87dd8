from __future__ import annotations

from inspect import isawaitable

import msgspec
import pytest

from eap.ams.spec import HopSpec, MqttSpec, RouteSpec, RoutingSpec, TransportKind
from eap.control.device import RoutingDifference, RunningRouting
from eap.errors import ControlError, EnvironmentalError
from eap.runtime.store import StationStore
from eap.services.control.route_methods import RoutingMethods
from eap.services.routing.station_routes import StationRoutes
from eap.services.routing.station_routing import StationRouting
from eap.services.transports.station_brokers import StationBrokers
from tests.support.routing import station
from tests.support.virtualtime import run_virtual

HOP = HopSpec(TransportKind.UDP, "eap0", "10.0.0.2:34980")
OLD = RoutingSpec()
NEW = RoutingSpec(routes=(RouteSpec(name="mill", net_id="10.0.0.2.1.1", hop=HOP),))


@pytest.fixture
def ask(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path))
    router, store = station("10.0.0.1.2.1"), StationStore("p", "left")
    routes = StationRoutes(router, OLD, store.routes)
    brokers = StationBrokers(router)
    routing = StationRouting("left", routes, store.routing, lambda told: None, brokers)
    routing.start()
    methods = RoutingMethods({"left": routing}).table()

    def call(method, **params):
        plain = {name: msgspec.to_builtins(value) for name, value in params.items()}
        result = methods[f"routing_{method}"]({"station": "left", **plain})
        return run_virtual(result) if isawaitable(result) else result

    return call


def test_apply_and_rollback(ask):
    assert ask("export") == RunningRouting(routing=OLD)
    difference = RoutingDifference(changes=["route mill: added"], refused=[])
    assert ask("plan", routing=NEW) == difference
    assert ask("apply", routing=NEW, cause="1") == difference
    assert ask("export") == RunningRouting(routing=NEW, previous=OLD, cause="1")
    assert ask("rollback").changes == ["route mill: removed"]
    assert ask("export") == RunningRouting(routing=OLD, previous=NEW, cause="1", undone=True)


def test_routing_change_that_is_impossible_here_is_refused(ask, monkeypatch):
    def missing():
        raise EnvironmentalError("MQTT needs aiomqtt")

    monkeypatch.setattr("eap.net.mqtt.require_mqtt", missing)
    broker = RoutingSpec(mqtt=(MqttSpec(network="n", host="broker"),))
    for answer in (ask("plan", routing=broker), ask("apply", routing=broker)):
        assert answer.refused == ["MQTT needs aiomqtt"]
    assert ask("export") == RunningRouting(routing=OLD)


@pytest.mark.parametrize("method", ["plan", "apply"])
def test_malformed_routing_is_refused(ask, method):
    with pytest.raises(ControlError, match="unknown field `rout`"):
        ask(method, routing={"rout": []})


def test_a_station_that_is_not_here(ask):
    with pytest.raises(ControlError, match="unknown station 'lefd', did you mean left") as caught:
        ask("export", station="lefd")
    assert caught.value.code == "unknown_name"


def test_routing_that_cannot_be_stored_is_an_error(ask, tmp_path):
    (tmp_path / "p").write_text("")
    with pytest.raises(ControlError, match="cannot be kept") as caught:
        ask("apply", routing=NEW)
    assert caught.value.code == "unavailable"
