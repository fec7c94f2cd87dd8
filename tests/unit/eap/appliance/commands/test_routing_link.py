from __future__ import annotations

import msgspec

from eap.aoe.spec import AccessRule, RoutingSpec
from eap.appliance.commands.routing_link import RoutingLink
from eap.appliance.control_routing import RoutingDifference, RunningRouting

TOLD = RoutingSpec(access=(AccessRule("a"),))
DIFFERENCE = {"changes": ["access rule a: added"], "refused": []}


class Asked(list):
    def __call__(self, method, station, **params):
        self.append((method, station, params))
        return {"routing": {}} if method == "routing_export" else DIFFERENCE


def test_stations_are_asked_about_what_the_plant_file_says():
    asked = Asked()
    link = RoutingLink(asked, {"left": TOLD})
    told = msgspec.to_builtins(TOLD)
    assert link.export("left") == RunningRouting(routing=RoutingSpec())
    assert link.plan("left") == RoutingDifference(**DIFFERENCE)
    assert link.apply("left", "1") == link.rollback("left") == link.plan("left")
    assert asked[1:4] == [
        ("routing_plan", "left", {"routing": told}),
        ("routing_apply", "left", {"routing": told, "cause": "1"}),
        ("routing_rollback", "left", {}),
    ]


def test_where_it_says_nothing_nobody_is_asked():
    asked = Asked()
    link = RoutingLink(asked, {})
    assert link.export("left") is None
    assert link.plan("left") == RoutingDifference(changes=[], refused=[])
    assert asked == []
