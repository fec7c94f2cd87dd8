"""PDO mapping and PDO assignment as objects, with the rules for changing them (ETG.1000.6).

Subindex 0 is written 0 first, then the others, then subindex 0 again, which judges the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RW_PREOP, Access, Entry, ObjectCode, OdObject

RX_PDO, TX_PDO = 0x1600, 0x1A00
PDOS = 0x200
"""How many PDOs each direction may have."""
RX_ASSIGN, TX_ASSIGN = 0x1C12, 0x1C13
MAX_ASSIGNED = 8
"""PDOs that a sync manager may carry, unless it carries more from the start."""
SPARE_ENTRIES = 8
"""What a PDO may map beside what it maps from the start."""
MIN_ROOM = 32
"""Octets that a direction may take at least, whatever it takes from the start."""
_MAX_ENTRIES = 254
_PDO_MAPPING = 0x21


def mapping(
    index: int, mapped: Sequence[tuple[int, int, int]], dictionary: ObjectDictionary
) -> OdObject:
    """Make a PDO of entries (index, subindex, bits), in which nothing is padded.

    Only the sync manager begins and ends on whole bytes: PDOs of one bit follow each other bit by
    bit, as those of real digital terminals do.  A master may change it in PreOp.

    Raises:
        ValueError: there is no such PDO, or it maps too much.
    """
    if not (0 <= index - RX_PDO < PDOS or 0 <= index - TX_PDO < PDOS):
        raise ValueError(f"0x{index:04X} is no PDO (0x1600 to 0x17FF, 0x1A00 to 0x1BFF)")
    name = "TxPDO" if index >= TX_PDO else "RxPDO"
    numbers = [entry << 16 | sub << 8 | bits for entry, sub, bits in mapped]
    if any(bits > 0xFF for _, _, bits in mapped) or len(numbers) > _MAX_ENTRIES:
        raise ValueError(
            f"{name} maps {len(numbers)} entries, expected at most 254 of at most 255 bits"
        )
    room = max(MIN_ROOM, (sum(number & 0xFF for number in numbers) + 7) // 8)
    limit = min(len(numbers) + SPARE_ENTRIES, _MAX_ENTRIES)
    count = Entry("SubIndex 000", "USINT", RW_PREOP, len(numbers), maximum=limit)
    entries = {0: count, **_numbered(index, numbers, limit, "UDINT", count)}
    count.write = _judge_mapping(index, entries, dictionary, room)
    return OdObject(index, f"{name} mapping", ObjectCode.RECORD, entries, data_type=_PDO_MAPPING)


def assignment(index: int, pdos: Sequence[int], dictionary: ObjectDictionary) -> OdObject:
    """Make the list of PDOs of a sync manager; a master may change it in PreOp."""
    limit = max(MAX_ASSIGNED, len(pdos))
    count = Entry("SubIndex 000", "USINT", RW_PREOP, len(pdos), maximum=limit)
    entries = {0: count, **_numbered(index, pdos, limit, "UINT", count)}
    room = max(MIN_ROOM, (sum(_bits(dictionary, pdo) for pdo in pdos) + 7) // 8)
    count.write = _judge_assignment(index, entries, dictionary, room)
    title = "RxPDO assign" if index == RX_ASSIGN else "TxPDO assign"
    return OdObject(index, title, ObjectCode.ARRAY, entries, data_type=0x06)


def _numbered(
    index: int, numbers: Sequence[int], limit: int, kind: str, count: Entry
) -> dict[int, Entry]:
    return {
        sub: Entry(
            f"SubIndex {sub:03}",
            kind,
            RW_PREOP,
            numbers[sub - 1] if sub <= len(numbers) else 0,
            write=_while_empty(index, sub, count),
        )
        for sub in range(1, limit + 1)
    }


def _while_empty(index: int, sub: int, count: Entry) -> Callable[[bytes], None]:
    def check(octets: bytes) -> None:
        del octets
        if count.octets[0]:
            raise SdoAbortError(AbortCode.SUBINDEX_0_NOT_ZERO, index, sub)

    return check


def _judge_mapping(
    index: int, entries: dict[int, Entry], dictionary: ObjectDictionary, room: int
) -> Callable[[bytes], None]:
    right = Access.TX_MAPPABLE if index >= TX_PDO else Access.RX_MAPPABLE
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
            if bits != entry.kind.bit_length and number not in own:
                raise SdoAbortError(AbortCode.PARAMETER, index, sub,
                                    f"{bits} bits of {entry.kind.text}")  # fmt: skip
        if total > 8 * room:
            raise SdoAbortError(AbortCode.PDO_LENGTH, index, 0, f"{total} bits of {8 * room}")

    return check


def _judge_assignment(
    index: int, entries: dict[int, Entry], dictionary: ObjectDictionary, room: int
) -> Callable[[bytes], None]:
    first = RX_PDO if index == RX_ASSIGN else TX_PDO

    def check(octets: bytes) -> None:
        total = 0
        for sub in range(1, octets[0] + 1):
            pdo = entries[sub].value
            if pdo not in dictionary or not 0 <= pdo - first < PDOS:
                raise SdoAbortError(AbortCode.PARAMETER, index, sub, f"no PDO 0x{pdo:04X}")
            total += _bits(dictionary, pdo)
        if total > 8 * room:
            raise SdoAbortError(AbortCode.PDO_LENGTH, index, 0, f"{total} bits of {8 * room}")

    return check


def _bits(dictionary: ObjectDictionary, pdo: int) -> int:
    item = dictionary[pdo]
    return sum(int(item.entries[sub].value) & 0xFF for sub in range(1, item.max_subindex + 1))
