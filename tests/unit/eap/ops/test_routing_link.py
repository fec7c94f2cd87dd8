from __future__ import annotations

from pathlib import Path

from eap.ams.spec import AccessRule, RoutingSpec
from eap.control.device import RoutingDifference, RunningRouting
from eap.ops.plant import PlantLink

TOLD = RoutingSpec(access=(AccessRule("a"),))
DIFFERENCE = {"changes": ["access rule a: added"], "refused": []}


class FakeClient(list):
    def call(self, method, /, *, within_s, **params):
        self.append((method.name, params))
        return method.decode({"routing": {}} if method.name == "routing_export" else DIFFERENCE)


def link_to(client: FakeClient, routing: dict[str, RoutingSpec]) -> PlantLink:
    return PlantLink({"left": client}, Path("line.yaml"), routing=routing)


def test_plant_link_routing_of_plant_file_asks_the_station():
    client = FakeClient()
    link = link_to(client, {"left": TOLD})
    told = {"access": [{"name": "a"}]}  # fields with their defaults are left out
    assert link.export_routing("left") == RunningRouting(routing=RoutingSpec())
    assert link.plan_routing("left") == RoutingDifference(**DIFFERENCE)
    applied, taken_back = link.apply_routing("left", "1"), link.rollback_routing("left")
    assert applied == taken_back == link.plan_routing("left")
    assert client[1:4] == [
        ("routing_plan", {"station": "left", "routing": told}),
        ("routing_apply", {"station": "left", "routing": told, "cause": "1"}),
        ("routing_rollback", {"station": "left"}),
    ]


def test_plant_link_without_routing_in_plant_file_asks_nothing():
    client = FakeClient()
    link = link_to(client, {})
    assert link.export_routing("left") is None
    assert link.plan_routing("left") == RoutingDifference(changes=[], refused=[])
    assert client == []
