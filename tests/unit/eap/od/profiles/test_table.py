from __future__ import annotations

from eap.od.model import RO, RW, ObjectCode
from eap.od.profiles.eap1000 import Derived, EapLive
from eap.od.profiles.table import CONFIG, EntryRow, ObjectRow, config, derived, fixed, live

PLAIN = ObjectRow(
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
        EntryRow(1, "a", "UINT", RW, "d"),
    )
    assert [row.access for row in rows] == [CONFIG, RO, RO, RO, RW]
    assert (rows[0].default, rows[2].live, rows[2].unit, rows[3].derived) == (
        3, "value", "ms", "count",
    )  # fmt: skip
