"""Devices that describe their objects as CoE does."""

from __future__ import annotations

import pytest

from eap.codec.coe import EntryDescription, ObjectDescription
from eap.codec.datatypes import parse
from eap.errors import ControlError
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import Access, ObjectCode
from eap.ops.od import Content, EntryInfo, ObjectInfo
from eap.ops.od_devices import entry_info, object_info, read_all, with_entries

UINT = parse("UINT")
LEVEL = ObjectInfo(0x2000, "level", "VAR", 2)


class Tank:
    """One object with three entries, the second of which nobody knows of."""

    error: Exception = SdoAbortError(AbortCode.WRITE_ONLY, 0x2000, 2)
    known = (EntryInfo(0, "now", UINT, "r"), None, EntryInfo(2, "secret", UINT, "rw"))

    def objects(self):
        return [LEVEL]

    def describe(self, index):
        return with_entries(self, LEVEL)

    def entry(self, index, subindex):
        return self.known[subindex]

    def read(self, index, subindex, *, complete=False):
        if subindex:
            raise self.error
        return b"\7\0"


def test_descriptions_are_read():
    kind = ObjectDescription(0x2000, UINT.code, 2, ObjectCode.ARRAY, "level")
    assert object_info(0x2000, kind) == ObjectInfo(0x2000, "level", "ARRAY", 2)
    unknown = ObjectDescription(0x2000, UINT.code, 0, 77, "x")
    assert object_info(0x2000, unknown).code == "77"
    for access, shown in ((Access.READ_ANY, "r"), (Access.WRITE_ANY, "w"), (Access(0), "")):
        entry = EntryDescription(0x2000, 1, UINT.code, 16, access, "now")
        assert entry_info(1, entry) == EntryInfo(1, "now", UINT, shown)


def test_read_all_stores_refusals_with_the_entry():
    now, secret = read_all(Tank(), SdoAbortError)
    found = with_entries(Tank(), LEVEL)
    assert [each.subindex for each in found.entries] == [0, 2]
    assert now == Content(LEVEL, found.entries[0], b"\7\0")
    assert (secret.octets, secret.error) == (None, str(Tank.error))


def test_other_errors_are_raised():
    tank = Tank()
    tank.error = ControlError("gone")
    with pytest.raises(ControlError, match="gone"):
        list(read_all(tank, SdoAbortError))


def test_unreadable_entries_are_skipped():
    tank = Tank()
    tank.known = (EntryInfo(0, "command", UINT, "w"), None, None)
    (command,) = read_all(tank)
    assert (command.octets, command.error) == (None, "")
