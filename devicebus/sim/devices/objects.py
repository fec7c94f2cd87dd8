"""Object dictionary of a simulated device, from its description.

Identity, sync manager types, PDO mapping and PDO assignment are built in the same way for all kinds
of devices.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from devicebus.sim.device import FaultyDictionary
from devicebus.sim.spec import AccessKind, ChannelSpec, EntrySpec, ObjectSpec, SlaveSpec
from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.ids import ObjectId
from eap.od.abort import AbortCode, SdoAbortError
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

RX_PDO, TX_PDO = 0x1600, 0x1A00
PDOS = 0x200
"""Limit for the PDOs of each direction."""
RX_ASSIGN, TX_ASSIGN = 0x1C12, 0x1C13
MAX_ASSIGNED = 8
"""Minimum limit for the PDOs of a sync manager."""
SPARE_ENTRIES = 8
"""Entries that a PDO can map in addition to its default mapping."""
MIN_ROOM = 32
"""Minimum limit for the process data of a direction, in bytes."""
_MAX_ENTRIES = 254
_PDO_MAPPING = 0x21


def mapping(
    index: int,
    mapped: Sequence[tuple[int, int, int]],
    dictionary: ObjectDictionary,
    *,
    is_output: bool,
    is_fixed: bool = False,
) -> OdObject:
    """Return the mapping object of a PDO of entries (index, subindex, bits), without padding.

    Only the sync manager begins and ends on whole bytes: PDOs of one bit follow each other bit by
    bit, as in real digital terminals.  A master may change a mapping in PREOP that is not fixed.

    Raises:
        ValueError: the PDO maps too much.
    """
    name = "RxPDO" if is_output else "TxPDO"
    numbers = [entry << 16 | sub << 8 | bits for entry, sub, bits in mapped]
    if any(bits > 0xFF for _, _, bits in mapped) or len(numbers) > _MAX_ENTRIES:
        raise ValueError(
            f"{name} maps {len(numbers)} entries, expected at most 254 of at most 255 bits"
        )
    room = max(MIN_ROOM, (sum(number & 0xFF for number in numbers) + 7) // 8)
    spare = 0 if is_fixed else SPARE_ENTRIES
    limit = min(len(numbers) + spare, _MAX_ENTRIES)
    access = RO if is_fixed else RW_PREOP
    count = Entry("SubIndex 000", "USINT", access, len(numbers), maximum=limit)
    entries = {0: count, **_numbered(index, numbers, limit, "UDINT", count)}
    right = Access.RX_MAPPABLE if is_output else Access.TX_MAPPABLE
    count.write = _check_mapping(index, entries, dictionary, room, right)
    return OdObject(index, f"{name} mapping", ObjectCode.RECORD, entries, data_type=_PDO_MAPPING)


class PdoRules(NamedTuple):
    """PDOs that a sync manager may have."""

    known: Container[int]
    excludes: Mapping[int, Container[int]] = MappingProxyType({})
    """PDOs that cannot be assigned together with a PDO."""
    is_fixed: bool = False
    """True if a master cannot change the assignment."""


def assignment(
    index: int,
    pdos: Sequence[int],
    dictionary: ObjectDictionary,
    rules: PdoRules,
    *,
    is_output: bool,
) -> OdObject:
    """Return the assignment object of a sync manager; a master may change it in PREOP."""
    limit = max(MAX_ASSIGNED, len(pdos))
    access = RO if rules.is_fixed else RW_PREOP
    count = Entry("SubIndex 000", "USINT", access, len(pdos), maximum=limit)
    entries = {0: count, **_numbered(index, pdos, limit, "UINT", count)}
    room = max(MIN_ROOM, (sum(_bits(dictionary, pdo) for pdo in pdos) + 7) // 8)
    count.write = _check_assignment(index, entries, dictionary, room, rules)
    title = "RxPDO assign" if is_output else "TxPDO assign"
    return OdObject(index, title, ObjectCode.ARRAY, entries, data_type=0x06)


def _numbered(
    index: int, numbers: Sequence[int], limit: int, kind: str, count: Entry
) -> dict[int, Entry]:
    return {
        sub: Entry(
            f"SubIndex {sub:03}",
            kind,
            count.access,
            numbers[sub - 1] if sub <= len(numbers) else 0,
            write=_while_empty(index, sub, count),
        )
        for sub in range(1, limit + 1)
    }


def _while_empty(index: int, sub: int, count: Entry) -> Callable[[bytes], None]:
    def check(octets: bytes) -> None:
        del octets
        # 0x06010003: entries are writable only while subindex 0 is 0, so no half-written list is
        # valid.
        if count.octets[0]:
            raise SdoAbortError(AbortCode.SUBINDEX_0_NOT_ZERO, index, sub)

    return check


def _check_mapping(
    index: int, entries: dict[int, Entry], dictionary: ObjectDictionary, room: int, right: Access
) -> Callable[[bytes], None]:
    own = {entry.value for entry in entries.values()}

    def check(octets: bytes) -> None:
        total = 0
        for sub in range(1, octets[0] + 1):
            number = entries[sub].value
            place, bits = (number >> 16, number >> 8 & 0xFF), number & 0xFF
            total += bits
            if not place[0]:
                continue
            if place[0] not in dictionary or place[1] not in dictionary[place[0]].entries:
                raise SdoAbortError(AbortCode.NOT_MAPPABLE, index, sub, "there is no such entry")
            entry = dictionary.entry(*place)
            if not entry.access & right:
                raise SdoAbortError(AbortCode.NOT_MAPPABLE, index, sub, entry.name)
            # What the device description itself maps is accepted, also with another length.
            if bits != entry.kind.bit_length and number not in own:
                raise SdoAbortError(AbortCode.PARAMETER, index, sub,
                                    f"{bits} bits of {entry.kind.text}")  # fmt: skip
        if total > 8 * room:
            raise SdoAbortError(AbortCode.PDO_LENGTH, index, 0, f"{total} bits of {8 * room}")

    return check


def _check_assignment(
    index: int, entries: dict[int, Entry], dictionary: ObjectDictionary, room: int, rules: PdoRules
) -> Callable[[bytes], None]:
    def check(octets: bytes) -> None:
        total = 0
        before: list[int] = []
        for sub in range(1, octets[0] + 1):
            pdo = entries[sub].value
            if pdo not in dictionary or pdo not in rules.known:
                raise SdoAbortError(AbortCode.PARAMETER, index, sub, f"no PDO 0x{pdo:04X}")
            other = next((each for each in before if each in rules.excludes.get(pdo, ())), None)
            if other is not None:
                message = f"0x{other:04X} and 0x{pdo:04X} exclude each other"
                raise SdoAbortError(AbortCode.PARAMETER, index, sub, message)
            before.append(pdo)
            total += _bits(dictionary, pdo)
        if total > 8 * room:
            raise SdoAbortError(AbortCode.PDO_LENGTH, index, 0, f"{total} bits of {8 * room}")

    return check


def _bits(dictionary: ObjectDictionary, pdo: int) -> int:
    item = dictionary[pdo]
    return sum(int(item.entries[sub].value) & 0xFF for sub in range(1, item.max_subindex + 1))


OUTPUTS, INPUTS = 0x7000, 0x6000
_ACCESS = {
    AccessKind.READ: RO,
    AccessKind.WRITE: WO,
    AccessKind.READ_WRITE: RW,
    AccessKind.CONFIGURATION: RW_PREOP,
}
_SM_TYPES = (1, 2, 3, 4)
_IDENTITY_TYPE = 0x23


def object_ids_of(channels: Sequence[ChannelSpec], base: int) -> list[ObjectId]:
    """Return the entry of each of *channels*; by default they count up from *base*:01."""
    found = []
    free = 0
    for channel in channels:
        if channel.object:
            found.append(ObjectId.parse(channel.object))
        else:
            # Only entries without an object of their own take a number of the default range.
            free += 1
            found.append(ObjectId(base + 0x10 * ((free - 1) // 200), (free - 1) % 200 + 1))
    return found


def build_dictionary(spec: SlaveSpec, device_type: int) -> ObjectDictionary:
    """Build the dictionary of the device that *spec* describes.

    Raises:
        ValueError: a data type, a value or an entry is invalid.
    """
    dictionary = FaultyDictionary(identity_objects(spec, device_type))
    for each in spec.objects:
        dictionary.add(described_object(each))
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
    """Add the entries of one direction, the PDOs that map them, and their assignment."""
    pdos: dict[int, list[tuple[int, int, int]]] = {}
    assigned: dict[int, bool] = {}
    for channel, (index, subindex) in zip(channels, object_ids_of(channels, base), strict=True):
        kind = datatypes.parse(channel.type)
        if index:
            kind = add_entry(dictionary, index, subindex, channel, access).kind
        bits = channel.bits or kind.bit_length
        pdo = channel.pdo or first_pdo
        if not 0 <= pdo - first_pdo < PDOS:
            raise ValueError(f"{channel.name}: 0x{pdo:04X} is no PDO of its direction")
        pdos.setdefault(pdo, []).append((index, subindex, bits))
        assigned[pdo] = assigned.get(pdo, False) or channel.assigned
    is_output = first_pdo == RX_PDO
    for pdo, mapped in pdos.items():
        dictionary.add(mapping(pdo, mapped, dictionary, is_output=is_output))
    rules = PdoRules(range(first_pdo, first_pdo + PDOS))
    default = [pdo for pdo in pdos if assigned[pdo]]
    assign = RX_ASSIGN if is_output else TX_ASSIGN
    dictionary.add(assignment(assign, default, dictionary, rules, is_output=is_output))


def identity_objects(spec: SlaveSpec, device_type: int) -> Iterable[OdObject]:
    """Yield the objects 0x1000 to 0x1018."""
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
        ("Revision number", spec.revision or 0),
        ("Serial number", spec.serial),
    )
    entries = {sub: Entry(name, "UDINT", RO, value) for sub, (name, value) in enumerate(numbers, 1)}
    yield record(0x1018, "Identity", entries, data_type=_IDENTITY_TYPE)


def described_object(spec: ObjectSpec) -> OdObject:
    """Return the object of *spec*; raise ValueError for an invalid type or value."""
    if not spec.entries:
        entry = _entry(spec)
        if spec.mappable:
            is_input = spec.access is AccessKind.READ
            entry.access |= Access.TX_MAPPABLE if is_input else Access.RX_MAPPABLE
        return OdObject(spec.index, spec.name, ObjectCode.VAR, {0: entry})
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
    """Return *limit* as a value of its type; raise ValueError if it does not fit."""
    if limit is None or kind.scalar_range is None:
        return None
    number = limit if isinstance(kind.scalar_range[0], float) else int(limit)
    kind.encode(number)
    return number


def add_entry(
    dictionary: ObjectDictionary, index: int, subindex: int, channel: ChannelSpec, access: Access
) -> Entry:
    """Return the entry of *channel*, with additional rights if it exists already."""
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
