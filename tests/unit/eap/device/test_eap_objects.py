from __future__ import annotations

import pytest

from eap.codec import datatypes
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import Access, ObjectCode, variable
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000keys import Frame, Var


@pytest.mark.parametrize("row", profile.ALL, ids=lambda row: f"{row.first:04X}")
def test_an_object_has_what_its_row_says(udp, row):
    item = udp.make_object(row, row.last)
    assert item.name == row.title(row.last)
    assert item.code is row.code
    for each in row.entries:
        if not each.last:
            entry = item.entries[each.subindex]
            assert entry.name == each.name
            assert entry.access == each.access
            if each.kind:
                assert entry.kind == datatypes.parse(each.kind)
    if row.code is ObjectCode.VAR:
        assert list(item.entries) == [0]
    else:
        assert item.max_subindex == row.fixed_count
        is_writable = bool(item.entries[0].access & Access.WRITE_PREOP)
        assert is_writable == (row.dynamic or row.list_row is not None)


def test_units_and_limits_are_those_of_the_row(udp):
    entry = udp[0xF800].entries[8]
    assert (entry.unit, entry.minimum, entry.maximum) == (0xFA030000, 100, 60_000_000)


def test_objects_outside_the_profile_are_not_added(udp):
    with pytest.raises(SdoAbortError) as caught:
        udp.add(variable(0x5000, "stranger", "UINT"))
    assert caught.value.code == AbortCode.NO_OBJECT


def test_members_are_listed_in_order_of_their_indexes(udp):
    for index in (0x6005, 0x6001, 0x7000):
        udp.make(profile.row_of(index), index)
    assert udp.members(*profile.VARIABLES) == [0x6001, 0x6005, 0x7000]
    udp.remove(0x6005)
    udp.remove(0x6005)
    assert udp.members(profile.TX_VARIABLE) == [0x6001]


def test_a_longest_list_has_names_for_all_entries(udp):
    item = udp.make_object(profile.TX_FRAME, 0x8000, last=254)
    assert item.entries[Frame.TXPD].name == "TxPD 0"
    assert item.entries[254].name == "TxPD 238"
    assert item.max_subindex == 254


def test_growing_what_has_no_list_changes_nothing(udp):
    item = udp.make(profile.TX_PD, 0xD000)
    udp.grow(0xD000, 30)
    assert item.max_subindex == max(item.entries) == profile.TX_PD.fixed_count


def test_a_type_makes_value_and_default_as_large(udp):
    item = udp.make(profile.RX_VARIABLE, 0x7000)
    udp.put(0x7000, Var.TYPE_NAME, b"BLOCK(9)")
    assert item.entries[Var.VALUE].kind.size == item.entries[Var.DEFAULT].kind.size == 9
    both = Access.RX_MAPPABLE | Access.TX_MAPPABLE
    assert item.entries[Var.VALUE].access & both == both


def test_rights_follow_the_entry_that_grants_them(udp):
    item = udp.make(profile.TX_FRAME, 0x8000)
    udp.put(0x8000, Frame.CHANGEABLE, b"\1")
    assert item.entries[Frame.DESTINATION_IP].access & Access.WRITE_OP
    assert not item.entries[Frame.DIVIDER].access & Access.WRITE_OP
    udp.put(0x8000, Frame.CHANGEABLE, b"\0")
    assert not item.entries[Frame.DESTINATION_IP].access & Access.WRITE_OP
