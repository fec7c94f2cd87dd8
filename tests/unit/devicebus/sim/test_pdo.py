"""Process data packed and unpacked as the dictionary maps it."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from devicebus.sim.pdo import ProcessData
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RW, array, variable

KINDS = {"BOOL": 1, "BIT3": 3, "USINT": 8, "INT": 16, "UINT24": 24, "REAL": 32, "ULINT": 64}


def mapped(kinds: list[str], assign: int, pdo: int) -> ObjectDictionary:
    dictionary = ObjectDictionary()
    numbers = []
    for number, kind in enumerate(kinds):
        dictionary.add(variable(0x2000 + number, kind, kind, RW))
        numbers.append(0x2000 + number << 16 | KINDS[kind])
    dictionary.add(array(pdo, "PDO", "UDINT", numbers, RW))
    dictionary.add(array(assign, "assign", "UINT", [pdo], RW))
    return dictionary


def test_process_data_without_assignment_is_empty():
    process_data = ProcessData(ObjectDictionary())
    process_data.configure()
    assert (process_data.outputs.size, process_data.inputs.pack()) == (0, b"")


def test_plan_by_hand():
    dictionary = mapped(["UINT24", "BOOL", "INT"], 0x1C13, 0x1A00)
    for index, value in ((0x2000, 0x030201), (0x2001, True), (0x2002, -1)):
        dictionary.entry(index, 0).value = value
    process_data = ProcessData(dictionary)
    process_data.configure()
    assert process_data.inputs.size == 6
    assert process_data.inputs.pack() == bytes.fromhex("010203 ffff01")


def test_process_data_padding_and_missing_entries_take_bits():
    dictionary = mapped(["USINT"], 0x1C12, 0x1600)
    dictionary.add(array(0x1600, "PDO", "UDINT", [8, 0x9999_0008, 0x2000_0008, 0x2000_0908], RW))
    process_data = ProcessData(dictionary)
    process_data.configure()
    process_data.outputs.unpack(b"abcd")
    assert (process_data.outputs.size, dictionary.entry(0x2000, 0).octets) == (4, b"c")


def test_pdo_that_is_not_assigned():
    dictionary = mapped(["USINT", "BOOL"], 0x1C12, 0x1600)
    process_data = ProcessData(dictionary)
    assert process_data.write_pdo(0x1600, b"\7\1")
    assert process_data.read_pdo(0x1600) == b"\7\1"
    assert not process_data.write_pdo(0x1600, b"\7")
    assert not process_data.write_pdo(0x1601, b"")
    assert process_data.read_pdo(0x1601) is None


def test_short_texts_and_wide_mappings_keep_their_places():
    dictionary = ObjectDictionary([variable(0x2000, "t", "STRING(4)", RW, "ab"),
                                   variable(0x2001, "n", "USINT", RW, 255)])  # fmt: skip
    dictionary.add(array(0x1A00, "PDO", "UDINT", [0x2000_0020, 0x2001_000C, 4], RW))
    dictionary.add(array(0x1C13, "assign", "UINT", [0x1A00], RW))
    process_data = ProcessData(dictionary)
    process_data.configure()
    assert process_data.inputs.pack() == b"ab\0\0\xff\0"
    process_data.inputs.unpack(b"wxyz\x12\xff")
    assert dictionary.entry(0x2001, 0).octets == b"\x12"


@given(st.lists(st.sampled_from(sorted(KINDS)), min_size=1, max_size=8), st.data())
def test_outputs_come_back_as_inputs(kinds, data):
    outputs = mapped(kinds, 0x1C12, 0x1600)
    plan = ProcessData(outputs)
    plan.configure()
    bits = sum(KINDS[kind] for kind in kinds)
    word = data.draw(st.integers(0, (1 << bits) - 1))
    octets = word.to_bytes((bits + 7) // 8, "little")
    plan.outputs.unpack(octets)
    outputs.add(array(0x1C13, "assign", "UINT", [0x1600]))
    plan.configure()
    assert plan.inputs.pack() == octets
