"""Objects of any device as rows."""

from __future__ import annotations

import pytest

from eap.codec import datatypes
from eap.errors import ConfigError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RW, Entry, record
from eap.ops import od
from eap.ops.od import Content, EntryInfo, ObjectInfo
from tests.support.oddevice import MemoryDevice, mixer


@pytest.fixture
def device():
    return MemoryDevice(mixer())


def test_entry_without_a_description_is_shown_as_bytes(device, monkeypatch):
    monkeypatch.setattr(device, "entry", lambda *_: None)
    row = od.read_entry(device, 0xD000, 7)
    assert (row.name, row.type, row.value, row.data) == ("", None, 10000, "10270000")
    assert od.read_entry(device, 0x1008, 0).value == int.from_bytes(b"mixer #1", "little")
    assert od.read_entry(device, 0x8000, 3).value is None
    with pytest.raises(ConfigError, match="give it with --type, such as UINT"):
        od.write_entry(device, 0xD000, 7, "1")
    od.write_entry(device, 0xD000, 7, "1", datatypes.parse("UDINT"))
    assert device.written == [(0xD000, 7, b"\1\0\0\0")]


def test_bits_of_a_whole_object():
    entries = {
        1: Entry("Ready", "BOOL", RW, value=True),
        2: Entry("Mode", "BIT3", RW, 5),
        5: Entry("Level", "UINT", RW, 0x1234),
    }
    device = MemoryDevice(ObjectDictionary([record(0x6000, "Inputs", entries)]))
    row = od.read_object(device, 0x6000, 1)
    assert [(each.subindex, each.value) for each in row.entries] == [
        (1, True),
        (2, 5),
        (5, 0x1234),
    ]
    row = od.read_object(device, 0x6000, 0)
    assert [each.value for each in row.entries] == [5, True, 5, 0x1234]


def test_texts_of_a_whole_object_end_where_they_end(device, monkeypatch):
    kind = datatypes.parse("STRING(8)")
    name = EntryInfo(1, "Name", kind, "rw")
    found = ObjectInfo(0x6000, "Name", "RECORD", 1, entries=(name,))
    monkeypatch.setattr(device, "describe", lambda _: found)
    monkeypatch.setattr(device, "read", lambda *_, complete: b"level".ljust(kind.size, b"\0"))
    (row,) = od.read_object(device, 0x6000, 1).entries
    assert (row.value, row.data) == ("level", b"level".hex())


def test_whole_object_of_unknown_types_is_bytes(device, monkeypatch):
    unknown = EntryInfo(7, "Cycle time", None, "rw")
    found = ObjectInfo(0xD000, "TxPD 0", "RECORD", 7, entries=(unknown,))
    monkeypatch.setattr(device, "describe", lambda _: found)
    row = od.read_object(device, 0xD000, 1)
    assert (row.data, row.entries) == ("10270000", [])


def test_dump_keeps_what_cannot_be_read():
    found = ObjectInfo(0x2000, "Drive", "RECORD", 1)
    entry = EntryInfo(1, "Torque", datatypes.parse("INT"), "r")
    (row,) = od.dump_rows([Content(found, entry, None, "0x2000:01: no data available")])
    assert (row.object, row.data, row.value) == ("Drive", None, None)
    assert row.error == "0x2000:01: no data available"
