"""Objects made of a profile's rows."""

from __future__ import annotations

from eap.codec import datatypes
from eap.od.model import RW, ObjectCode
from eap.od.profiles.maker import live_octets, live_source, make_object
from eap.od.profiles.master1100 import CONFIGURED_LIST, DIAGNOSIS, MasterLive


def test_live_entries_are_asked_for_and_written() -> None:
    written = []
    item = make_object(
        DIAGNOSIS, 0xA003, live_source(lambda key: 7 if key == MasterLive.AL_STATUS else 0),
        write=lambda key, data: written.append((key, data)), extent=17,
    )  # fmt: skip
    assert (item.name, item.code) == ("Diagnosis data slave 3", ObjectCode.RECORD)
    assert item.max_subindex == max(item.entries) == 17
    assert item.entries[1].octets == b"\7\0"
    assert item.entries[1].write is None
    assert item.entries[2].access == RW
    item.entries[2].write(b"\2\0")
    assert written == [(MasterLive.AL_CONTROL, b"\2\0")]


def test_lists_are_as_long_as_they_are_said_to_be() -> None:
    item = make_object(CONFIGURED_LIST, 0xF020, live_source(lambda key: 0), last=3)
    assert list(item.entries) == [0, 1, 2, 3]
    assert item.max_subindex == 3
    assert item.data_type == datatypes.parse("UINT").code
    assert make_object(CONFIGURED_LIST, 0xF020, live_source(lambda key: 0)).max_subindex == 0


def test_values_beyond_their_type_are_its_largest() -> None:
    assert live_octets(datatypes.parse("USINT"), 300) == b"\xff"
    assert live_octets(datatypes.parse("STRING(3)"), "abcd") == b"abc"
    assert live_octets(datatypes.parse("BLOCK(2)"), b"ab") == b"ab"
