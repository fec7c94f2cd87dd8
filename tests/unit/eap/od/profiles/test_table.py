from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.od.model import RO, RW, ObjectCode
from eap.od.profiles.eap1000_keys import Derived, EapLive
from eap.od.profiles.master1100 import CONFIGURED_LIST, DIAGNOSIS, MasterLive
from eap.od.profiles.table import (
    CONFIG,
    Form,
    ProfileEntry,
    ProfileObject,
    config,
    derived,
    fixed,
    from_text,
    live,
    live_octets,
    live_source,
    make_object,
    to_text,
)

PLAIN = ProfileObject(
    0xD000, 0xD00F, "TxPD {n}", ObjectCode.RECORD,
    (config(1, "One", "UINT", "1."), fixed(2, "Two", "UINT", "2.")), "PDs.",
)  # fmt: skip
LISTING = PLAIN._replace(entries=(*PLAIN.entries, config(5, "PD {n}", "UINT", "3.", last=9)))


def test_a_row_is_found_by_its_subindex():
    assert [row and row.name for row in map(PLAIN.row, (0, 1, 2, 3))] == [None, "One", "Two", None]
    assert [row and row.name for row in map(LISTING.row, (4, 5, 9, 10))] == [
        None, "PD {n}", "PD {n}", None,
    ]  # fmt: skip


def test_lists_stand_behind_what_is_always_there():
    assert (PLAIN.list_row, PLAIN.fixed_count, PLAIN.last_subindex) == (None, 2, 2)
    assert LISTING.list_row is LISTING.entries[-1]
    assert (LISTING.fixed_count, LISTING.last_subindex) == (4, 9)


def test_objects_and_entries_are_numbered():
    assert PLAIN.title(0xD00F) == "TxPD 15"
    assert LISTING.entries[-1].numbered(7) == "PD 2"
    assert PLAIN.entries[0].numbered(1) == "One"


def test_rows_say_where_their_content_comes_from():
    rows = (
        config(1, "a", "UINT", "d", default=3),
        fixed(1, "a", "UINT", "d"),
        live(1, "a", "UINT", EapLive.VALUE, "d", unit="ms"),
        derived(1, "a", "UINT", Derived.COUNT, "d"),
        ProfileEntry(1, "a", "UINT", RW, "d"),
    )
    assert [row.access for row in rows] == [CONFIG, RO, RO, RO, RW]
    assert (rows[0].default, rows[2].live, rows[2].unit, rows[3].derived) == (
        3, "value", "ms", "count",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("form", "kind", "octets", "text"),
    [
        (Form.PLAIN, "UINT", b"\x39\x30", "12345"),
        (Form.PLAIN, "BOOL", b"\1", "true"),
        (Form.PLAIN, "STRING(9)", b"level", "level"),
        (Form.PLAIN, "UINT[2]", b"\1\0\2\0", "1, 2"),
        (Form.PLAIN, "BLOCK(3)", b"\xab\0\1", "ab 00 01"),
        (Form.HEX, "UDINT", b"\x89\x13\xe8\x03", "0x03E81389"),
        (Form.INDEX, "UINT", b"\x00\x1a", "0x1A00"),
        (Form.INDEX, "UINT", b"\0\0", "0x0000"),
        (Form.MAPPING, "UDINT", b"\x10\x01\x00\x60", "0x6000:01/16"),
        (Form.MAC, "BLOCK(6)", b"\1\1\5\4\0\0", "01:01:05:04:00:00"),
        (Form.NET_ID, "BLOCK(6)", b"\1\2\3\4\5\6", "1.2.3.4.5.6"),
        (Form.IP, "BLOCK(4)", b"\x0a\0\0\1", "10.0.0.1"),
    ],
)
def test_octets_and_text_are_the_same(form, kind, octets, text):
    parsed = datatypes.parse(kind)
    assert to_text(form, parsed, octets) == text
    assert from_text(form, parsed, text) == octets


@given(st.sampled_from(list(Form)), st.binary(min_size=6, max_size=6))
def test_any_octets_have_a_text_that_reads_back(form, octets):
    size = {Form.IP: "BLOCK(4)", Form.MAC: "BLOCK(6)", Form.NET_ID: "BLOCK(6)"}
    kind = datatypes.parse(size.get(form, "UDINT"))
    data = octets[: kind.size]
    assert from_text(form, kind, to_text(form, kind, data)) == data


@pytest.mark.parametrize(
    ("form", "kind", "text"),
    [
        (Form.PLAIN, "UINT", "65536"),
        (Form.INDEX, "UINT", "none"),
        (Form.MAPPING, "UDINT", "6000/16"),
        (Form.MAPPING, "UDINT", "6000:zz/16"),
        (Form.MAPPING, "UDINT", "6000:01/256"),
        (Form.MAC, "BLOCK(6)", "1.2.3.4"),
        (Form.NET_ID, "BLOCK(6)", "1.2.3.4"),
        (Form.IP, "BLOCK(4)", "1.2.3.400"),
    ],
)
def test_text_of_another_form_is_refused(form, kind, text):
    with pytest.raises(ValueError, match=text.split(":", maxsplit=1)[0][:3]):
        from_text(form, datatypes.parse(kind), text)


def test_numbers_may_be_typed_in_other_ways():
    assert from_text(Form.INDEX, datatypes.parse("UINT"), "26") == b"\x1a\0"
    assert from_text(Form.MAPPING, datatypes.parse("UDINT"), "0x60000110") == b"\x10\x01\0\x60"


def test_live_entries_are_read_and_written() -> None:
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
