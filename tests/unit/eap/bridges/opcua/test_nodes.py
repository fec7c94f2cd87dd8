from __future__ import annotations

from eap.bridges.opcua.nodes import (
    MethodNode,
    ObjectNode,
    StationFacts,
    VariableNode,
    compare,
    plan_nodes,
)
from eap.bridges.values import BridgeVariable

STATION = StationFacts("press", "5.1.1.1.1.1", ("bus0",))
AXIS = "ST_Axis<24/8:position@0 LREAL,speed@8 INT(-10..10),end@12 ST_End<8/4:x@0 REAL,y@4 REAL>>"


def variable(name: str, kind: str, *, unit: str = "", settable: bool = False) -> BridgeVariable:
    return BridgeVariable("press", name, kind, unit, "", settable)


def ids(*variables: BridgeVariable) -> list[str]:
    return list(plan_nodes([STATION], variables).nodes)


def test_plan_has_station_with_state_variables_bus_and_methods():
    plan = plan_nodes([STATION], [variable("speed", "REAL", unit="1/min")])
    assert list(plan.nodes) == [
        "press",
        "press/state",
        "press/net_id",
        "press#RequestState",
        "press/bus0",
        "press/bus0#Rescan",
        "press/speed",
    ]
    assert isinstance(plan.nodes["press"], ObjectNode)
    assert isinstance(plan.nodes["press/bus0#Rescan"], MethodNode)
    speed = plan.nodes["press/speed"]
    assert isinstance(speed, VariableNode)
    assert (speed.parent, speed.name, speed.unit) == ("press", "speed", "1/min")


def test_dots_of_names_are_levels_of_the_tree():
    plan = plan_nodes(
        [STATION], [variable("bus0.door.is_closed", "BOOL"), variable("bus0.state", "BYTE")]
    )
    assert plan.nodes["press/bus0.door"] == ObjectNode("press/bus0.door", "press/bus0", "door")
    assert plan.nodes["press/bus0.door.is_closed"].parent == "press/bus0.door"
    assert plan.nodes["press/bus0.state"].name == "state"
    known = {""}
    for node in plan.nodes.values():
        assert node.parent in known
        known.add(node.node_id)


def test_members_of_a_struct_lie_below_it_with_their_paths():
    plan = plan_nodes([STATION], [variable("axis", AXIS, settable=True)])
    x = plan.nodes["press/axis.end.x"]
    assert isinstance(x, VariableNode)
    assert (x.parent, x.path, x.variable) == ("press/axis.end", ("end", "x"), "press/axis")
    assert x.is_settable
    assert plan.nodes["press/axis.speed"].limits == (-10, 10)
    names = [each.name for each in plan.types.values()]
    assert names == ["StationState", "ST_End", "ST_Axis"]


def test_variable_with_the_name_of_a_member_goes_first():
    plan = plan_nodes([STATION], [variable("axis", AXIS), variable("axis.position", "UINT")])
    assert plan.nodes["press/axis.position"].variable == "press/axis.position"


def test_variable_called_state_is_the_one_of_the_plant():
    plan = plan_nodes([STATION], [variable("state", "UINT")])
    assert plan.nodes["press/state"].variable == "press/state"


def test_range_of_the_plant_file_goes_before_that_of_the_type():
    plan = plan_nodes([STATION], [variable("axis", AXIS)], {"press/axis.speed": (0, 5)})
    assert plan.nodes["press/axis.speed"].limits == (0, 5)


def test_comparison_names_removed_added_and_changed_nodes():
    old = plan_nodes([STATION], [variable("axis", AXIS), variable("speed", "REAL")])
    new = plan_nodes([STATION], [variable("speed", "LREAL"), variable("load.now", "REAL")])
    change = compare(old, new)
    assert [each.node_id for each in change.removed] == [
        "press/axis.end.y", "press/axis.end.x", "press/axis.end", "press/axis.speed",
        "press/axis.position", "press/axis",
    ]  # fmt: skip
    assert [each.node_id for each in change.added] == ["press/load", "press/load.now"]
    assert [each.node_id for each in change.replaced] == ["press/speed"]
    assert not change.types
    assert compare(new, new) == ((), (), (), ())


def test_nodes_below_one_that_is_made_anew_are_made_anew():
    old = plan_nodes([STATION], [variable("axis", AXIS)])
    new = plan_nodes([STATION], [variable("axis.end.x", "REAL"), variable("axis.more", "REAL")])
    change = compare(old, new)
    assert "press/axis.end.x" in [each.node_id for each in change.removed]
    assert "press/axis.end.x" in [each.node_id for each in change.added]


def test_node_that_becomes_another_class_is_removed_and_added():
    old = plan_nodes([STATION], [variable("load", "REAL")])
    new = plan_nodes([STATION], [variable("load.now", "REAL")])
    change = compare(old, new)
    assert [each.node_id for each in change.removed] == ["press/load"]
    assert [each.node_id for each in change.added] == ["press/load", "press/load.now"]
