"""PDO mapping and PDO assignment as objects, with the rules for changing them (ETG.1000.6).

Subindex 0 is written 0 first, then the others, then subindex 0 again, which judges the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, RW_PREOP, Entry, ObjectCode, OdObject

MAX_ASSIGNED = 8
_PDO_MAPPING = 0x21


def mapping(index: int, mapped: Sequence[tuple[int, int, int]], name: str) -> OdObject:
    """Make a fixed PDO of entries (index, subindex, bits); it ends on a whole octet."""
    rest = -sum(bits for _, _, bits in mapped) % 8
    numbers = [entry << 16 | sub << 8 | bits for entry, sub, bits in mapped]
    if rest:
        numbers.append(rest)
    if any(bits > 0xFF for _, _, bits in mapped) or len(numbers) > 0xFE:
        raise ValueError(
            f"{name} maps {len(numbers)} entries, expected at most 254 of at most 255 bits"
        )
    entries = {sub: Entry(f"SubIndex {sub:03}", "UDINT", RO, n) for sub, n in enumerate(numbers, 1)}
    return OdObject(index, f"{name} mapping", ObjectCode.RECORD, entries, data_type=_PDO_MAPPING)


def assignment(index: int, pdos: Sequence[int], dictionary: ObjectDictionary) -> OdObject:
    """Make the list of PDOs of a sync manager; a master may change it in PreOp."""
    count = Entry("SubIndex 000", "USINT", RW_PREOP, len(pdos), maximum=MAX_ASSIGNED)
    entries = {0: count}
    for sub in range(1, MAX_ASSIGNED + 1):
        number = pdos[sub - 1] if sub <= len(pdos) else 0
        entries[sub] = Entry(
            f"SubIndex {sub:03}", "UINT", RW_PREOP, number, write=_while_empty(index, sub, count)
        )
    count.write = _judge(index, entries, dictionary)
    title = "RxPDO assign" if index == 0x1C12 else "TxPDO assign"
    return OdObject(index, title, ObjectCode.ARRAY, entries, data_type=0x06)


def _while_empty(index: int, sub: int, count: Entry) -> Callable[[bytes], None]:
    def check(octets: bytes) -> None:
        del octets
        if count.octets[0]:
            raise SdoAbortError(AbortCode.SUBINDEX_0_NOT_ZERO, index, sub)

    return check


def _judge(
    index: int, entries: dict[int, Entry], dictionary: ObjectDictionary
) -> Callable[[bytes], None]:
    def check(octets: bytes) -> None:
        for sub in range(1, octets[0] + 1):
            pdo = int.from_bytes(entries[sub].octets, "little")
            if pdo not in dictionary:
                raise SdoAbortError(AbortCode.PARAMETER, index, sub, f"no PDO 0x{pdo:04X}")

    return check
