from __future__ import annotations

import struct

from eap.od.model import RO, RW, Entry, ObjectCode, OdObject, OdState, array, record, variable


def test_states_know_their_rights() -> None:
    assert [(s.read_right.value, s.write_right.value) for s in OdState] == [
        (0x01, 0x08),
        (0x02, 0x10),
        (0x04, 0x20),
    ]


def test_stored_entry_starts_with_its_default() -> None:
    entry = Entry("Vendor ID", "UDINT", RO, 2)
    assert (entry.octets, entry.value, entry.default) == (b"\x02\0\0\0", 2, b"\x02\0\0\0")
    entry.value = 7
    assert entry.octets == b"\x07\0\0\0"


def test_text_is_as_long_as_its_content() -> None:
    entry = Entry("Device name", "STRING(32)", RW, "island")
    assert entry.octets == b"island"
    assert entry.value == "island"
    entry.value = "x"
    assert entry.octets == b"x"


def test_live_entry_reads_its_source() -> None:
    cell = [1]
    entry = Entry("Quality", "UINT", RO, read=lambda: struct.pack("<H", cell[0]))
    cell[0] = 515
    assert (entry.value, entry.octets) == (515, b"\x03\x02")


def test_subindex_0_of_records_counts_and_of_variables_is_the_value() -> None:
    identity = record(0x1018, "Identity", {1: Entry("a", "UDINT"), 4: Entry("b", "UDINT")})
    assert identity.max_subindex == 4
    assert list(identity.entries) == [0, 1, 4]
    assert variable(0x1000, "Device type", "UDINT", RO, 5001).max_subindex == 0
    empty = OdObject(0x1C12, "RxPDO assign", ObjectCode.ARRAY, {}, data_type=6)
    assert (empty.max_subindex, empty.data_type) == (0, 6)


def test_array_names_and_types() -> None:
    item = array(0xF020, "Addresses", "UINT", [1001, 1002], RW)
    assert item.data_type == 0x06
    assert [entry.value for entry in item.entries.values()] == [2, 1001, 1002]
    assert item.entries[2].name == "SubIndex 002"


def test_variables_have_no_complete_access() -> None:
    assert not variable(0x1000, "Device type", "UDINT").complete_access
    assert record(0x1018, "Identity", {1: Entry("a", "UDINT")}).complete_access
