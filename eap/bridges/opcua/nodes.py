"""Nodes of a plant: stations as objects, their variables, members of structs, types and methods.

Identifiers of nodes are texts in the namespace of the plant and never change: ``STATION``,
``STATION/VARIABLE``, ``STATION/VARIABLE.MEMBER``, ``STATION#METHOD``, ``type:NAME:DIGEST``.  A dot
in the name of a variable is a level of the tree, so the variables of a bus lie below its object.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

from eap.bridges.opcua.values import Definition, UaType, converter, definitions_of
from eap.bridges.values import BridgeVariable
from eap.codec import datatypes
from eap.codec.basetypes import DataType, Integer
from eap.codec.datatypes import parts_of
from eap.config.web import STATE

NET_ID = "net_id"
"""Property of a station."""
STATES = Definition(
    "type:StationState", "StationState", names=((1, "INIT"), (2, "PREOP"), (4, "SAFEOP"), (8, "OP"))
)
"""States of a station, as ETG.1000.6 numbers them."""


class ObjectNode(NamedTuple):
    """Object: a station, or a level in the names of its variables.

    Attributes:
        node_id: Identifier.
        parent: Identifier of the node above; empty for a station.
        name: Browse name.
        comment: Description.
    """

    node_id: str
    parent: str
    name: str
    comment: str = ""


class VariableNode(NamedTuple):
    """Variable, or a member of a struct.

    Attributes:
        node_id: Identifier; of a variable of the plant the name by which it is written.
        parent: Identifier of the node above.
        name: Browse name.
        kind: Its type in the plant; None for state and NetID of a station.
        type: Its data type.
        unit: Its unit, empty without one.
        limits: Smallest and largest value, None if its type limits nothing.
        comment: Description.
        is_settable: True if clients may write it, as far as their role and the rules allow.
        path: Members that lead to it from the variable that *variable* names; empty for itself.
        variable: Variable of the plant with its value.
    """

    node_id: str
    parent: str
    name: str
    kind: DataType | None
    type: UaType
    unit: str = ""
    limits: tuple[float, float] | None = None
    comment: str = ""
    is_settable: bool = False
    path: tuple[str, ...] = ()
    variable: str = ""


class MethodNode(NamedTuple):
    """Method of a station or a bus; *argument* is its name and type, None without one."""

    node_id: str
    parent: str
    name: str
    comment: str
    argument: tuple[str, UaType] | None = None


PlantNode: TypeAlias = ObjectNode | VariableNode | MethodNode


class StationFacts(NamedTuple):
    """Station as ``status`` describes it, with the names of its bus ports."""

    name: str
    net_id: str
    buses: tuple[str, ...]


class NodePlan(NamedTuple):
    """Nodes of a plant by their identifiers, each behind its parent, and the types they need."""

    nodes: Mapping[str, PlantNode]
    types: Mapping[str, Definition]


class PlanChange(NamedTuple):
    """Difference of two plans.

    Attributes:
        removed: Nodes that are gone, those below others first.
        added: New nodes, each behind its parent.
        replaced: Nodes with the same identifier, class and parent that are described otherwise.
        types: New types; old ones stay, because clients may still have values of them.
    """

    removed: tuple[PlantNode, ...]
    added: tuple[PlantNode, ...]
    replaced: tuple[PlantNode, ...]
    types: tuple[Definition, ...]


def plan_nodes(
    stations: Iterable[StationFacts],
    variables: Iterable[BridgeVariable],
    ranges: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> NodePlan:
    """Return the nodes of *stations* with *variables*; *ranges* are by ``STATION/NAME``."""
    nodes: dict[str, PlantNode] = {}
    by_station: dict[str, list[BridgeVariable]] = {}
    for variable in variables:
        by_station.setdefault(variable.station, []).append(variable)
    for station in stations:
        own = by_station.get(station.name, [])
        nodes |= {each.node_id: each for each in _station_nodes(station, own)}
    types: dict[str, Definition] = {}
    for node in list(nodes.values()):
        if isinstance(node, VariableNode):
            if node.node_id in ranges:
                nodes[node.node_id] = node._replace(limits=ranges[node.node_id])
            types |= {each.node_id: each for each in definitions_of(node.type)}
    return NodePlan(nodes, types)


def compare(old: NodePlan, new: NodePlan) -> PlanChange:
    """Return the steps from one plan to another."""
    removed, replaced = [], []
    gone: set[str] = set()
    for node_id, before in old.nodes.items():
        after = new.nodes.get(node_id)
        is_other = type(after) is not type(before) or before.parent in gone
        if after is None or is_other or after.parent != before.parent:
            removed.append(before)
            gone.add(node_id)
        elif after != before:
            replaced.append(after)
    added = [
        node for node_id, node in new.nodes.items() if node_id not in old.nodes or node_id in gone
    ]
    types = [each for node_id, each in new.types.items() if node_id not in old.types]
    return PlanChange(tuple(reversed(removed)), tuple(added), tuple(replaced), tuple(types))


def _station_nodes(station: StationFacts, variables: list[BridgeVariable]) -> Iterator[PlantNode]:
    yield ObjectNode(station.name, "", station.name, f"station {station.net_id}")
    names = {each.variable for each in variables}
    yield from _own_nodes(station, names)
    levels: set[str] = set()
    for port in station.buses:
        if port not in names:
            levels.add(port)
            yield ObjectNode(f"{station.name}/{port}", station.name, port, "bus")
        yield MethodNode(
            f"{station.name}/{port}#Rescan",
            f"{station.name}/{port}",
            "Rescan",
            "Scans the bus and compares its slaves with the configured ones.",
        )
    # A level before what lies below it: a variable may be the level of others.
    for variable in sorted(variables, key=lambda each: each.variable.count(".")):
        yield from _levels_of(station.name, variable.variable, names, levels)
        yield from _variable_nodes(variable, names)


def _own_nodes(station: StationFacts, names: set[str]) -> Iterator[PlantNode]:
    text = converter(datatypes.parse("STRING(24)")).type
    number = converter(datatypes.parse("DINT")).type._replace(data_type=STATES)
    if STATE not in names:
        yield VariableNode(
            f"{station.name}/{STATE}", station.name, STATE, None, number, comment="EtherCAT state"
        )
    if NET_ID not in names:
        yield VariableNode(
            f"{station.name}/{NET_ID}", station.name, NET_ID, None, text, comment="NetID"
        )
    yield MethodNode(
        f"{station.name}#RequestState",
        station.name,
        "RequestState",
        "Brings the station to INIT, PREOP, SAFEOP or OP.",
        ("state", number),
    )


def _levels_of(
    station: str, variable: str, names: set[str], levels: set[str]
) -> Iterator[ObjectNode]:
    """Yield the objects above a variable that are not there yet."""
    parts = variable.split(".")
    for count in range(1, len(parts)):
        level = ".".join(parts[:count])
        if level not in names and level not in levels:
            levels.add(level)
            yield ObjectNode(f"{station}/{level}", _parent_id(station, level), parts[count - 1])


def _parent_id(station: str, name: str) -> str:
    level = name.rpartition(".")[0]
    return f"{station}/{level}" if level else station


def _variable_nodes(variable: BridgeVariable, names: set[str]) -> Iterator[VariableNode]:
    kind = datatypes.parse(variable.type)
    whole = VariableNode(
        variable.name,
        _parent_id(variable.station, variable.variable),
        variable.variable.rpartition(".")[2],
        kind,
        converter(kind).type,
        variable.unit,
        _limits(kind),
        variable.comment,
        variable.is_settable,
        variable=variable.name,
    )
    yield whole
    for path, part in parts_of(kind):
        if f"{variable.variable}{path}" in names:
            continue  # a variable of this name goes first, as in all commands
        steps = tuple(path[1:].split("."))
        yield VariableNode(
            f"{variable.name}{path}",
            ".".join((variable.name, *steps[:-1])),
            steps[-1],
            part.kind,
            converter(part.kind).type,
            limits=_limits(part.kind),
            is_settable=variable.is_settable,
            path=steps,
            variable=variable.name,
        )


def _limits(kind: DataType) -> tuple[float, float] | None:
    return kind.bounds if isinstance(kind, Integer) else None
