from __future__ import annotations

from itertools import pairwise

import pytest

from eap.codec import datatypes
from eap.od.model import Access, ObjectCode
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000_keys import Derived, EapLive
from eap.od.profiles.table import CONFIG, OWN_TYPE, UNITS
from eap.pd.device import DeviceState
from eap.pd.spec import LengthCheck, Substitute, Wake, Writer

ENTRIES = [(row, entry) for row in profile.ALL for entry in row.entries]


def _id(pair):
    row, entry = pair
    return f"{row.first:04X}:{entry.subindex:02X}"


@pytest.mark.parametrize(("row", "entry"), ENTRIES, ids=map(_id, ENTRIES))
def test_every_entry_is_named_described_and_of_a_type(row, entry):
    assert entry.name
    assert entry.description.endswith(".")
    assert row.description.endswith(".")
    assert entry.unit in UNITS
    assert entry.access & Access.READ_ANY == Access.READ_ANY
    if entry.kind != OWN_TYPE:
        kind = datatypes.parse(entry.kind)
        if entry.default is not None:
            kind.encode(entry.default)
    assert not (entry.live and entry.derived)
    assert not entry.changeable or entry.access == CONFIG
    if entry.live:
        assert entry.live in set(EapLive)
    if entry.derived:
        assert entry.derived in set(Derived)


def test_ranges_do_not_overlap_and_are_found_by_any_index_in_them():
    ends = [(row.first, row.last) for row in profile.ALL]
    assert all(before[1] < after[0] for before, after in pairwise(ends))
    for row in profile.ALL:
        assert profile.find(row.first) is profile.find(row.last) is row
        assert profile.row_of(row.first) is row
    for index in (0x0000, 0x1001, 0x15FF, 0x2E00, 0x5FFF, 0x9000, 0xF0FF, 0xFFFF):
        assert profile.find(index) is None
    with pytest.raises(LookupError, match="0x5000"):
        profile.row_of(0x5000)


def test_subindexes_are_in_order_and_only_the_last_is_a_list():
    for row in profile.ALL:
        subindexes = [entry.subindex for entry in row.entries]
        assert subindexes == sorted(set(subindexes))
        assert not any(entry.last for entry in row.entries[:-1])
        if row.code is ObjectCode.VAR:
            assert subindexes == [0]
        else:
            assert subindexes[0] == 1


def test_companions_have_room_for_all_they_accompany():
    accompanied = [row for row in profile.ALL if row.companion]
    assert [row.companion for row in accompanied] == [0xA000, 0xB000, 0xC000]
    for row in accompanied:
        companion = profile.row_of(row.companion)
        assert companion.last - companion.first == row.last - row.first


def test_process_data_entries_have_sub_indexes_of_the_profile():
    """Sub-indexes 3, 4 and 6 of the first PD: ID, version and NetID of the publisher."""
    for row in (profile.TX_PD, profile.RX_PD):
        names = [row.row(subindex).name for subindex in (3, 4, 6)]
        assert names == ["PD ID", "Version", "Publisher"]
    assert profile.row_of(0xF800).row(8).name == "Device cycle time"
    assert profile.row_of(0xF100).row(1).name == "State"
    assert profile.row_of(0xF200).row(1).name == "Requested state"


def test_device_type_is_profile_and_module_profile():
    assert profile.row_of(0x1000).row(0).default == 0x03E81389


@pytest.mark.parametrize(
    ("index", "names"),
    [
        (0x6000, profile.Var),
        (0x8000, profile.FrameSub),
        (0xD000, profile.Tx),
        (0xE000, profile.Rx),
        (0xF100, profile.Status),
        (0xF800, profile.Configured),
        (0xF810, profile.PortSub),
    ],
)
def test_each_name_is_that_of_its_entry_and_none_is_missing(index, names):
    row = profile.row_of(index)
    table = {
        entry.name.removesuffix(" {n}").upper().replace(" ", "_").replace("-", "_"): entry.subindex
        for entry in row.entries
    }
    assert {each.name: each.value for each in names} == table


def test_received_variables_have_what_sent_ones_have_but_a_writer():
    sent, received = profile.TX_VARIABLE, profile.RX_VARIABLE
    assert [e.name for e in sent.entries if e.subindex != profile.Var.WRITER] == [
        e.name for e in received.entries
    ]


def test_every_key_is_shown_by_an_entry():
    entries = [entry for row in profile.ALL for entry in row.entries]
    assert {entry.live for entry in entries} - {""} == set(EapLive)
    assert {entry.derived for entry in entries} - {""} == set(Derived)


def test_numbers_stand_for_the_words_of_specifications():
    assert {each.name for each in profile.WrittenBy} == {each.name for each in Writer}
    assert {each.name for each in profile.Substituted} == {each.name for each in Substitute}
    assert {each.name for each in profile.Waking} == {each.name for each in Wake}
    assert {each.name for each in profile.LengthChecked} == {each.name for each in LengthCheck}
    assert (
        profile.row_of(0xF100)
        .row(1)
        .description.startswith(
            ", ".join(
                f"{state.value} {name}" for state, name in zip(DeviceState, _STATES, strict=True)
            )
        )
    )


_STATES = ("Init", "PreOp", "SafeOp", "Op")
