"""The object dictionary of a simulated device, from its description.

Identity, mailbox types and PDO objects are made here for all kinds of devices, so that every slave
describes itself in the same way.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from devicebus.sim.devices.pdoobjects import (
    PDOS,
    RX_ASSIGN,
    RX_PDO,
    TX_ASSIGN,
    TX_PDO,
    assignment,
    mapping,
)
from devicebus.sim.faultydictionary import FaultyDictionary
from devicebus.sim.spec import AccessKind, ChannelSpec, EntrySpec, ObjectSpec, SlaveSpec
from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.ids import ObjectId
from eap.od.dictionary import ObjectDictionary
from eap.od.model import (
    RO,
    RW,
    RW_PREOP,
    WO,
    Access,
    Entry,
    ObjectCode,
    OdObject,
    array,
    record,
    variable,
)

OUTPUTS, INPUTS = 0x7000, 0x6000
_ACCESS = {
    AccessKind.READ: RO,
    AccessKind.WRITE: WO,
    AccessKind.READ_WRITE: RW,
    AccessKind.CONFIGURATION: RW_PREOP,
}
_SM_TYPES = (1, 2, 3, 4)
_IDENTITY_TYPE = 0x23


def places(channels: Sequence[ChannelSpec], base: int) -> list[ObjectId]:
    """Return the entry of each of *channels*; those that name none count up from *base*:01."""
    found = []
    free = 0
    for channel in channels:
        if channel.object:
            found.append(ObjectId.parse(channel.object))
        else:
            free += 1
            found.append(ObjectId(base + 0x10 * ((free - 1) // 200), (free - 1) % 200 + 1))
    return found


def build_dictionary(spec: SlaveSpec, device_type: int) -> ObjectDictionary:
    """Make the dictionary of the device that *spec* describes.

    Raises:
        ValueError: a data type, a value or an entry in it cannot be.
    """
    dictionary = FaultyDictionary(_identity(spec, device_type))
    for each in spec.objects:
        dictionary.add(_object(each))
    _add_side(dictionary, spec.outputs, OUTPUTS, RX_PDO, RW | Access.RX_MAPPABLE)
    _add_side(dictionary, spec.inputs, INPUTS, TX_PDO, RO | Access.TX_MAPPABLE)
    dictionary.add(array(0x1C00, "Sync manager type", "USINT", _SM_TYPES))
    return dictionary


def _add_side(
    dictionary: ObjectDictionary,
    channels: Sequence[ChannelSpec],
    base: int,
    first_pdo: int,
    access: Access,
) -> None:
    """Add the entries of one direction, the PDOs that map them, and which of these count."""
    pdos: dict[int, list[tuple[int, int, int]]] = {}
    assigned: dict[int, bool] = {}
    for channel, (index, subindex) in zip(channels, places(channels, base), strict=True):
        kind = datatypes.parse(channel.type)
        if index:
            kind = _add_entry(dictionary, index, subindex, channel, access).kind
        bits = channel.bits or kind.bit_length
        pdo = channel.pdo or first_pdo
        if not 0 <= pdo - first_pdo < PDOS:
            raise ValueError(f"{channel.name}: 0x{pdo:04X} is no PDO of its direction")
        pdos.setdefault(pdo, []).append((index, subindex, bits))
        assigned[pdo] = assigned.get(pdo, False) or channel.assigned
    for pdo, mapped in pdos.items():
        dictionary.add(mapping(pdo, mapped, dictionary))
    assign = RX_ASSIGN if first_pdo == RX_PDO else TX_ASSIGN
    dictionary.add(assignment(assign, [pdo for pdo in pdos if assigned[pdo]], dictionary))


def _identity(spec: SlaveSpec, device_type: int) -> Iterable[OdObject]:
    yield variable(0x1000, "Device type", "UDINT", RO, device_type)
    yield variable(0x1001, "Error register", "USINT", RO)
    for index, name, text in (
        (0x1008, "Device name", spec.name),
        (0x1009, "Hardware version", "1"),
        (0x100A, "Software version", "1.0"),
    ):
        yield variable(index, name, f"STRING({max(1, len(text.encode()))})", RO, text)
    numbers = (
        ("Vendor ID", spec.vendor),
        ("Product code", spec.product),
        ("Revision number", spec.revision),
        ("Serial number", spec.serial),
    )
    entries = {sub: Entry(name, "UDINT", RO, value) for sub, (name, value) in enumerate(numbers, 1)}
    yield record(0x1018, "Identity", entries, data_type=_IDENTITY_TYPE)


def _object(spec: ObjectSpec) -> OdObject:
    if not spec.entries:
        return OdObject(spec.index, spec.name, ObjectCode.VAR, {0: _entry(spec)})
    return record(spec.index, spec.name, {each.subindex: _entry(each) for each in spec.entries})


def _entry(spec: ObjectSpec | EntrySpec) -> Entry:
    kind = datatypes.parse(spec.type)
    return Entry(
        spec.name,
        kind,
        _ACCESS[spec.access],
        spec.value,
        minimum=_limit(kind, spec.minimum),
        maximum=_limit(kind, spec.maximum),
    )


def _limit(kind: DataType, limit: float | None) -> float | None:
    """Return *limit* as a value of its type; raise ValueError if it is none."""
    if limit is None or kind.scalar_range is None:
        return None
    number = limit if isinstance(kind.scalar_range[0], float) else int(limit)
    kind.encode(number)
    return number


def _add_entry(
    dictionary: ObjectDictionary, index: int, subindex: int, channel: ChannelSpec, access: Access
) -> Entry:
    if index in dictionary and subindex in dictionary[index].entries:
        entry = dictionary[index].entries[subindex]
        entry.access |= access
        return entry
    kind = datatypes.parse(channel.type)
    value = kind.zero if channel.value == 0 else channel.value
    entry = Entry(channel.name, kind, access, value)
    if subindex == 0:
        dictionary.add(variable(index, channel.name, kind, access, value))
        return dictionary[index].entries[0]
    old = dict(dictionary[index].entries) if index in dictionary else {}
    old.pop(0, None)
    title = "Inputs" if access & Access.TX_MAPPABLE else "Outputs"
    dictionary.add(record(index, title, {**old, subindex: entry}))
    return entry
