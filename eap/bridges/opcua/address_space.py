"""Nodes of a plant in the address space of an asyncua server, with their values.

Nodes are entered directly: the services of asyncua compare each new node with all others of its
parent, and look through all nodes for each one that is removed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from functools import reduce
from time import time_ns
from typing import Any

from asyncua import ua
from asyncua.server.address_space import AttributeValue, NodeData
from asyncua.server.internal_server import InternalServer

from eap.bridges.opcua.nodes import (
    NET_ID,
    MethodNode,
    NodePlan,
    ObjectNode,
    PlanChange,
    PlantNode,
    VariableNode,
    compare,
)
from eap.bridges.opcua.units import NAMESPACE, unit_id
from eap.bridges.opcua.values import MISMATCH, BuiltIn, Definition, UaType, converter
from eap.bridges.values import Quality, Sample
from eap.config.web import STATE

READ = ua.AccessLevel.CurrentRead.mask
READ_WRITE = READ | ua.AccessLevel.CurrentWrite.mask

_STATUS = {
    Quality.GOOD: ua.StatusCode(ua.StatusCodes.Good),
    Quality.STALE: ua.StatusCode(ua.StatusCodes.UncertainLastUsableValue),
    Quality.BAD: ua.StatusCode(ua.StatusCodes.BadWaitingForInitialData),
}
_NOT_YET = Sample(None, Quality.BAD, 0)
_UNIT, _RANGE = "EngineeringUnits", "EURange"


class PlantAddressSpace:
    """Address space that follows the plans of a plant.

    Args:
        server: The server, after ``init``.
        namespace: Index of the plant's namespace.
        own_uri: Its URI, for units that no standard has.
        period_ms: Shortest useful sampling interval.

    Attributes:
        plan: The present nodes.
    """

    def __init__(
        self, server: InternalServer, namespace: int, own_uri: str, period_ms: int
    ) -> None:
        self.plan = NodePlan({}, {})
        self._space = server.aspace
        self._namespace = namespace
        self._own_uri = own_uri
        self._period_ms = period_ms
        self._parts: dict[str, list[VariableNode]] = {}
        self._shown: dict[str, tuple[Quality, Any]] = {}

    def node_id(self, identifier: str) -> ua.NodeId:
        """Return the NodeId of a node of the plant."""
        return ua.NodeId(identifier, self._namespace, ua.NodeIdType.String)

    def find(self, node_id: ua.NodeId) -> PlantNode | None:
        """Return the node of the plant with a NodeId, None if there is none."""
        return self.plan.nodes.get(node_id.Identifier) if self.is_own(node_id) else None

    def is_own(self, node_id: ua.NodeId) -> bool:
        """Return whether a NodeId may be one of the plant."""
        is_text = isinstance(node_id.Identifier, str)
        return bool(is_text and node_id.NamespaceIndex == self._namespace)

    async def follow(self, plan: NodePlan) -> PlanChange:
        """Enter the nodes of *plan* and remove all others; return the difference."""
        change = compare(self.plan, plan)
        # Before the nodes, which refer to them.
        for definition in change.types:
            self._add_type(definition)
        for node in change.removed:
            await self._remove(node)
        for node in change.added:
            self._add(node)
        for node in change.replaced:
            await self._replace(node)
        self.plan = plan
        self._parts = {}
        for node in plan.nodes.values():
            if isinstance(node, VariableNode) and node.variable:
                self._parts.setdefault(node.variable, []).append(node)
        return change

    async def take(self, samples: Mapping[str, Sample]) -> int:
        """Write values of variables to their nodes; return the number of nodes that changed."""
        count = 0
        for name, sample in samples.items():
            for node in self._parts.get(name, ()):
                count += await self._show(node, sample)
        return count

    async def take_part(self, node: VariableNode, plain: Any) -> None:
        """Write the value of a variable or a member that a client has set."""
        variable = self._shown.get(node.variable)
        if variable is None or not node.path:
            whole = plain
        else:
            whole = _with_part(variable[1], node.path, plain)
        await self.take({node.variable: Sample(whole, Quality.GOOD, time_ns())})

    async def set_station(self, station: str, state: int | None, net_id: str) -> None:
        """Write state and NetID of a station; the state is None while it is unknown."""
        now_ns = time_ns()
        quality = Quality.STALE if state is None else Quality.GOOD
        for name, value in ((STATE, state), (NET_ID, net_id)):
            node = self.plan.nodes.get(f"{station}/{name}")
            if isinstance(node, VariableNode) and not node.variable:
                before = self._shown.get(node.node_id, (quality, 0))[1]
                # The last known state stays, with a quality that says so.
                shown = before if value is None else value
                await self._show(node, Sample(shown, quality, now_ns))

    async def _show(self, node: VariableNode, sample: Sample) -> bool:
        try:
            value = reduce(lambda whole, step: whole[step], node.path, sample.value)
        except (KeyError, TypeError):
            value = None  # not received yet, or the type has just changed
        shown = sample.quality, value
        # asyncua calls monitored items back at every write, even of an equal value.
        if self._shown.get(node.node_id) == shown:
            return False
        self._shown[node.node_id] = shown
        data = data_value(node, value, sample, self.node_id)
        node_id = self.node_id(node.node_id)
        await self._space.write_attribute_value(node_id, ua.AttributeIds.Value, data)
        return True

    def _add(self, node: PlantNode) -> None:
        match node:
            case ObjectNode():
                kind = ua.ObjectIds.FolderType if node.parent else ua.ObjectIds.BaseObjectType
                self._enter(node, ua.NodeClass.Object, kind, {_A.EventNotifier: _byte(0)})
            case VariableNode():
                self._enter(
                    node, ua.NodeClass.Variable, _variable_type(node), self._attributes(node)
                )
                self._add_properties(node)
            case MethodNode():
                truth = ua.Variant(True, ua.VariantType.Boolean)
                attributes = {_A.Executable: truth, _A.UserExecutable: truth}
                self._enter(node, ua.NodeClass.Method, None, attributes)
                self._add_arguments(node)

    def _enter(
        self,
        node: PlantNode,
        node_class: ua.NodeClass,
        kind: int | None,
        attributes: dict[ua.AttributeIds, ua.Variant],
    ) -> None:
        is_top = not node.parent
        parent = ua.NodeId(ua.ObjectIds.ObjectsFolder) if is_top else self.node_id(node.parent)
        way = ua.ObjectIds.Organizes if is_top else ua.ObjectIds.HasComponent
        name = ua.QualifiedName(node.name, self._namespace)
        common = _texts(node.name, node.comment)
        self._link(
            parent, self.node_id(node.node_id), way, name, node_class, kind, common | attributes
        )

    def _link(
        self,
        parent: ua.NodeId,
        node_id: ua.NodeId,
        way: int,
        name: ua.QualifiedName,
        node_class: ua.NodeClass,
        kind: int | None,
        attributes: dict[ua.AttributeIds, ua.Variant],
    ) -> None:
        """Enter a node below *parent*; *kind* is its type definition."""
        data = NodeData(node_id)
        general = {
            _A.NodeId: ua.Variant(node_id, ua.VariantType.NodeId),
            _A.NodeClass: ua.Variant(node_class, ua.VariantType.Int32),
            _A.BrowseName: ua.Variant(name, ua.VariantType.QualifiedName),
            _A.WriteMask: ua.Variant(0, ua.VariantType.UInt32),
            _A.UserWriteMask: ua.Variant(0, ua.VariantType.UInt32),
        }
        for attribute, variant in (general | attributes).items():
            value = variant if isinstance(variant, ua.DataValue) else ua.DataValue(variant)
            data.attributes[attribute] = AttributeValue(value)
        definition = None if kind is None else ua.NodeId(kind)
        self._space[node_id] = data
        self._refer(parent, data, way, definition, is_forward=True)
        self._refer(node_id, self._space[parent], way, None, is_forward=False)
        if definition is not None:
            self._refer(
                node_id,
                self._space[definition],
                ua.ObjectIds.HasTypeDefinition,
                None,
                is_forward=True,
            )

    def _refer(
        self,
        source: ua.NodeId,
        target: NodeData,
        way: int,
        kind: ua.NodeId | None,
        *,
        is_forward: bool,
    ) -> None:
        reference = ua.ReferenceDescription()
        reference.ReferenceTypeId = ua.NodeId(way)
        reference.IsForward = is_forward
        reference.NodeId = target.nodeid
        for name in ("NodeClass", "BrowseName", "DisplayName"):
            found = target.attributes[getattr(ua.AttributeIds, name)].value
            setattr(reference, name, found.Value.Value)
        reference.TypeDefinition = kind or ua.NodeId()
        self._space[source].references.append(reference)

    async def _remove(self, node: PlantNode) -> None:
        self._shown.pop(node.node_id, None)
        for identifier in (*_properties_of(node), node.node_id):
            await self._remove_node(self.node_id(identifier))

    async def _remove_node(self, node_id: ua.NodeId) -> None:
        data = self._space[node_id]
        gone = ua.DataValue(
            ua.Variant(), ua.StatusCode(ua.StatusCodes.BadNodeIdUnknown), None, datetime.now(UTC)
        )
        # Monitored items report that the node is gone, and are of no use afterwards.
        callbacks = (
            data.attributes[_A.Value].datachange_callbacks if _A.Value in data.attributes else {}
        )
        for handle, callback in list(callbacks.items()):
            await callback(handle, gone)
            self._space.delete_datachange_callback(handle)
        for reference in data.references:
            if not reference.IsForward and (parent := self._space.get(reference.NodeId)):
                parent.references = [r for r in parent.references if r.NodeId != node_id]
        del self._space[node_id]

    async def _replace(self, node: PlantNode) -> None:
        """Describe a node anew; its monitored items stay."""
        node_id = self.node_id(node.node_id)
        value = self._space[node_id].attributes.get(_A.Value)
        # Members below it stay, with their monitored items.
        below = [
            each
            for each in self._space[node_id].references
            if each.IsForward and each.ReferenceTypeId.Identifier == ua.ObjectIds.HasComponent
        ]
        for identifier in _properties_of(self.plan.nodes[node.node_id]):
            await self._remove_node(self.node_id(identifier))
        parent = self._space[node_id].references[0].NodeId
        siblings = self._space[parent]
        siblings.references = [r for r in siblings.references if r.NodeId != node_id]
        self._shown.pop(node.node_id, None)
        self._add(node)
        self._space[node_id].references += below
        if value is not None:
            # The attribute that was there is kept: the callbacks of monitored items hang at it.
            value.value = self._space[node_id].attributes[_A.Value].value
            self._space[node_id].attributes[_A.Value] = value

    def _attributes(self, node: VariableNode) -> dict[ua.AttributeIds, Any]:
        level = READ_WRITE if node.is_settable else READ
        return {
            **self._type_attributes(node.type),
            _A.AccessLevel: _byte(level),
            _A.UserAccessLevel: _byte(level),
            _A.MinimumSamplingInterval: ua.Variant(float(self._period_ms), ua.VariantType.Double),
            _A.Historizing: ua.Variant(False, ua.VariantType.Boolean),
            _A.Value: data_value(node, None, _NOT_YET, self.node_id),
        }

    def _type_attributes(self, kind: UaType) -> dict[ua.AttributeIds, ua.Variant]:
        found = {
            _A.DataType: ua.Variant(self._data_type(kind), ua.VariantType.NodeId),
            _A.ValueRank: ua.Variant(kind.rank, ua.VariantType.Int32),
        }
        if kind.dimensions:
            sizes = list(kind.dimensions)
            found[_A.ArrayDimensions] = ua.Variant(sizes, ua.VariantType.UInt32, is_array=True)
        return found

    def _data_type(self, kind: UaType) -> ua.NodeId:
        if isinstance(kind.data_type, Definition):
            return self.node_id(kind.data_type.node_id)
        return ua.NodeId(int(kind.data_type))

    def _add_properties(self, node: VariableNode) -> None:
        if node.unit:
            number = unit_id(node.unit)
            unit = ua.EUInformation()
            unit.NamespaceUri = self._own_uri if number is None else NAMESPACE
            # OPC 10000-8: -1 where there is no unitId.
            unit.UnitId = -1 if number is None else number
            unit.DisplayName = unit.Description = ua.LocalizedText(node.unit)
            self._add_property(node.node_id, _UNIT, ua.ObjectIds.EUInformation, unit)
        if node.limits is not None:
            limits = ua.Range()
            limits.Low, limits.High = map(float, node.limits)
            self._add_property(node.node_id, _RANGE, ua.ObjectIds.Range, limits)

    def _add_arguments(self, node: MethodNode) -> None:
        if node.argument is None:
            return
        argument = ua.Argument()
        argument.Name, kind = node.argument
        argument.DataType = self._data_type(kind)
        argument.ValueRank = kind.rank
        self._add_property(
            node.node_id, "InputArguments", ua.ObjectIds.Argument, [argument], is_array=True
        )

    def _add_property(
        self,
        owner: str,
        name: str,
        data_type: int,
        value: Any,
        *,
        is_array: bool = False,
        variant_type: ua.VariantType = ua.VariantType.ExtensionObject,
    ) -> None:
        attributes = {
            **_texts(name, ""),
            _A.DataType: ua.Variant(ua.NodeId(data_type), ua.VariantType.NodeId),
            _A.ValueRank: ua.Variant(1 if is_array else -1, ua.VariantType.Int32),
            _A.AccessLevel: _byte(READ),
            _A.UserAccessLevel: _byte(READ),
            _A.Historizing: ua.Variant(False, ua.VariantType.Boolean),
            _A.Value: ua.Variant(value, variant_type, is_array=is_array),
        }
        if is_array:
            sizes = ua.Variant([len(value)], ua.VariantType.UInt32, is_array=True)
            attributes[_A.ArrayDimensions] = sizes
        self._link(
            self.node_id(owner),
            self.node_id(f"{owner}#{name}"),
            ua.ObjectIds.HasProperty,
            ua.QualifiedName(name, 0),
            ua.NodeClass.Variable,
            ua.ObjectIds.PropertyType,
            attributes,
        )

    def _add_type(self, definition: Definition) -> None:
        is_structure = bool(definition.fields)
        above = ua.ObjectIds.Structure if is_structure else ua.ObjectIds.Enumeration
        made = self._structure(definition) if is_structure else _enumeration(definition)
        attributes = {
            **_texts(definition.name, ""),
            _A.IsAbstract: ua.Variant(False, ua.VariantType.Boolean),
            _A.DataTypeDefinition: ua.Variant(made, ua.VariantType.ExtensionObject),
        }
        node_id = self.node_id(definition.node_id)
        self._link(
            ua.NodeId(above),
            node_id,
            ua.ObjectIds.HasSubtype,
            ua.QualifiedName(definition.name, self._namespace),
            ua.NodeClass.DataType,
            None,
            attributes,
        )
        if is_structure:
            self._link(
                node_id,
                self.node_id(definition.encoding_id),
                ua.ObjectIds.HasEncoding,
                ua.QualifiedName("Default Binary", 0),
                ua.NodeClass.Object,
                ua.ObjectIds.DataTypeEncodingType,
                {**_texts("Default Binary", ""), _A.EventNotifier: _byte(0)},
            )
        else:
            self._add_enum_names(definition)

    def _structure(self, definition: Definition) -> ua.StructureDefinition:
        made = ua.StructureDefinition()
        made.StructureType = ua.StructureType.Structure
        made.BaseDataType = ua.NodeId(ua.ObjectIds.Structure)
        made.DefaultEncodingId = self.node_id(definition.encoding_id)
        for name, kind in definition.fields:
            field = ua.StructureField()
            field.Name = name
            field.DataType = self._data_type(kind)
            field.ValueRank = kind.rank
            field.IsOptional = False
            field.ArrayDimensions = list(kind.dimensions)
            made.Fields.append(field)
        return made

    def _add_enum_names(self, definition: Definition) -> None:
        names = [name for _, name in definition.names]
        # EnumStrings is for numbers from 0 without gaps (OPC 10000-3).
        if [number for number, _ in definition.names] == list(range(len(names))):
            texts = [ua.LocalizedText(name) for name in names]
            self._add_property(
                definition.node_id,
                "EnumStrings",
                ua.ObjectIds.LocalizedText,
                texts,
                is_array=True,
                variant_type=ua.VariantType.LocalizedText,
            )
            return
        values = []
        for number, name in definition.names:
            value = ua.EnumValueType()
            value.Value = number
            value.DisplayName = ua.LocalizedText(name)
            values.append(value)
        self._add_property(
            definition.node_id, "EnumValues", ua.ObjectIds.EnumValueType, values, is_array=True
        )


_A = ua.AttributeIds


def data_value(
    node: VariableNode,
    plain: Any,
    sample: Sample,
    node_id: Callable[[str], ua.NodeId],
) -> ua.DataValue:
    """Return a plain value of a node as a DataValue with quality and time.

    Args:
        node: The node.
        plain: Its value; what its type does not have becomes a bad quality.
        sample: Quality and time.
        node_id: Returns the NodeId of an identifier.
    """
    now = datetime.now(UTC)
    # A value that never came has no time.
    made = datetime.fromtimestamp(sample.time_ns / 1e9, UTC) if sample.time_ns else now
    status = _STATUS[sample.quality]
    if sample.quality is Quality.BAD:
        return ua.DataValue(ua.Variant(), status, made, now)
    try:
        variant = _variant(node, plain, node_id)
    except MISMATCH:
        # The type of the variable has just changed: its node follows.
        return ua.DataValue(ua.Variant(), ua.StatusCode(ua.StatusCodes.BadTypeMismatch), made, now)
    return ua.DataValue(variant, status, made, now)


def taken_value(
    node: VariableNode, variant: ua.Variant, node_id: Callable[[str], ua.NodeId]
) -> Any:
    """Return the plain value of a variant that a client wrote.

    Raises:
        TypeError: the variant has another type or shape.
        ValueError: the value is none of the variable's type.
    """
    kind = node.type
    if node.kind is None or variant.VariantType != ua.VariantType(kind.built_in):
        raise TypeError(f"{node.node_id}: {variant.VariantType} is not {kind.built_in.name}")
    if variant.is_array is not bool(kind.dimensions):
        raise TypeError(f"{node.node_id}: an array is {'no' if variant.is_array else 'the'} value")
    value = variant.Value
    if isinstance(definition := kind.data_type, Definition) and definition.fields:
        value = _unwrapped(value, len(kind.dimensions), node_id(definition.encoding_id))
    try:
        return converter(node.kind).to_plain(value)
    except MISMATCH as exc:
        raise ValueError(f"{node.node_id}: {exc}") from None


def _unwrapped(value: Any, levels: int, encoding: ua.NodeId) -> Any:
    if levels:
        return [_unwrapped(each, levels - 1, encoding) for each in value or ()]
    if not isinstance(value, ua.ExtensionObject) or value.TypeId != encoding:
        raise TypeError("a structure of another type")
    return value.Body or b""


def _variant(node: VariableNode, plain: Any, node_id: Callable[[str], ua.NodeId]) -> ua.Variant:
    kind = node.type
    value = plain if node.kind is None else converter(node.kind).from_plain(plain)
    if isinstance(definition := kind.data_type, Definition) and definition.fields:
        encoding = node_id(definition.encoding_id)
        value = _wrapped(value, len(kind.dimensions), encoding)
    variant_type = ua.VariantType(kind.built_in)
    if not kind.dimensions:
        return ua.Variant(value, variant_type)
    sizes = list(kind.dimensions) if len(kind.dimensions) > 1 else None
    return ua.Variant(value, variant_type, sizes, is_array=True)


def _wrapped(value: Any, levels: int, encoding: ua.NodeId) -> Any:
    if levels:
        return [_wrapped(each, levels - 1, encoding) for each in value]
    return ua.ExtensionObject(encoding, value)


def _enumeration(definition: Definition) -> ua.EnumDefinition:
    made = ua.EnumDefinition()
    for number, name in definition.names:
        field = ua.EnumField()
        field.Value, field.Name = number, name
        field.DisplayName = ua.LocalizedText(name)
        made.Fields.append(field)
    return made


def _variable_type(node: VariableNode) -> int:
    is_number = node.type.built_in not in {
        BuiltIn.BOOLEAN, BuiltIn.STRING, BuiltIn.BYTESTRING, BuiltIn.EXTENSION_OBJECT
    }  # fmt: skip
    # Analog items are numbers (OPC 10000-8).
    if is_number and (node.unit or node.limits):
        return int(ua.ObjectIds.BaseAnalogType)
    return int(ua.ObjectIds.BaseDataVariableType)


def _properties_of(node: PlantNode) -> Iterator[str]:
    match node:
        case VariableNode():
            if node.unit:
                yield f"{node.node_id}#{_UNIT}"
            if node.limits is not None:
                yield f"{node.node_id}#{_RANGE}"
        case MethodNode() if node.argument is not None:
            yield f"{node.node_id}#InputArguments"


def _texts(name: str, comment: str) -> dict[ua.AttributeIds, ua.Variant]:
    return {
        _A.DisplayName: ua.Variant(ua.LocalizedText(name), ua.VariantType.LocalizedText),
        _A.Description: ua.Variant(ua.LocalizedText(comment), ua.VariantType.LocalizedText),
    }


def _byte(value: int) -> ua.Variant:
    return ua.Variant(value, ua.VariantType.Byte)


def _with_part(whole: Any, path: tuple[str, ...], plain: Any) -> Any:
    if not path:
        return plain
    if not isinstance(whole, Mapping):
        return whole
    # A copy: what is shown is compared with what comes next.
    return {**whole, path[0]: _with_part(whole.get(path[0]), path[1:], plain)}
