from __future__ import annotations

from eap.codec import datatypes
from eap.pd.layout import mirror
from eap.pd.spec import BusEntrySpec

TYPES = {name: datatypes.parse(name) for name in ("BOOL", "BIT3", "UINT", "USINT")}


def entries(*rows: tuple[str, int]) -> list[BusEntrySpec]:
    """Variables called like their types, each with its bits; without a name it is padding."""
    return [BusEntrySpec(name, 0x6000, at, bits) for at, (name, bits) in enumerate(rows, 1)]


def test_bits_and_padding_keep_their_places():
    plan = mirror(entries(("BOOL", 1), ("", 2), ("BIT3", 3), ("", 10), ("UINT", 16)), TYPES)
    assert plan.bit_offsets == {"BOOL": 0, "BIT3": 3, "UINT": 16}
    assert plan.size == 4


def test_a_number_in_the_middle_of_an_octet_moves_to_the_next():
    plan = mirror(entries(("BOOL", 1), ("UINT", 16), ("BIT3", 3), ("USINT", 8)), TYPES)
    assert plan.bit_offsets == {"BOOL": 0, "UINT": 8, "BIT3": 24, "USINT": 32}
    assert plan.size == 5


def test_the_last_octet_is_taken_as_a_whole():
    assert mirror(entries(("BOOL", 1)), TYPES).size == 1
    assert mirror([], TYPES).size == 0
