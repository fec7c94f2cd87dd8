from __future__ import annotations

import msgspec
import pytest
from hypothesis import given

from eap.device.configuration import (
    VERSION,
    StoredError,
    adopt_configuration,
    compare,
    dump_configuration,
    load_configuration,
    read_configuration,
    restore_configuration,
)
from eap.device.eap_dictionary import EapDictionary
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import OdState
from eap.od.profiles.eap1000 import RX_PD, TX_PD, TX_VARIABLE, FrameSub, Rx, Tx, Var
from eap.pd.spec import StationSpec
from tests.support.downloads import OP, copy, mapping, receiver, sender, tx_pd, variable, write
from tests.support.examples import examples
from tests.support.stations import BLANK, empty, filled, stations


@examples(30)
@given(stations())
def test_dumped_configuration_loads_unchanged(station: StationSpec):
    for name, each in filled(station).items():
        other = empty()[name]
        load_configuration(
            other, msgspec.json.decode(msgspec.json.encode(dump_configuration(each)))
        )
        assert read_configuration(other) == read_configuration(each)
        assert dump_configuration(other) == dump_configuration(each)


def test_a_mapping_that_is_being_written_is_kept_as_it_is(udp):
    sender(udp)
    write(udp, 0x1A00, 0, 0)
    write(udp, 0x1A00, 2, 0x6000_0110)
    other = copy(udp)
    assert list(other[0x1A00].entries) == [0, 1, 2]
    assert other[0x1A00].max_subindex == 0


def test_a_copy_is_another_one(udp):
    other = copy(sender(udp))
    write(other, 0xD000, Tx.PD_ID, 9)
    assert udp[0xD000].entries[Tx.PD_ID].value == 1


def test_restoring_replaces_everything_and_keeps_what_is_not_configuration(udp):
    sender(udp)
    udp.show_status(8, None)
    write(udp, 0xF811, 3, "239.1.1.1")
    write(udp, 0xF800, 8, 5000)
    kept = read_configuration(receiver(EapDictionary(BLANK, "eap0")))
    restore_configuration(udp, kept)
    assert read_configuration(udp) == kept
    assert 0x8000 not in udp
    assert udp.upload(0xF100, 1, OP) == b"\x08\0"
    restore_configuration(udp, {})
    assert read_configuration(udp) == read_configuration(EapDictionary(BLANK, "eap0"))


def test_adopting_touches_only_what_differs(udp):
    sender(udp)
    write(udp, 0xF811, 2, "239.1.1.1")
    wanted = copy(udp)
    write(wanted, 0xD000, Tx.PD_ID, 9)
    write(wanted, 0xF811, 0, 1)
    write(wanted, 0xF811, 1, "239.1.1.2")
    variable(wanted, 0x6005, "more")
    same = [udp[index] for index in (0x6000, 0x1A00, 0x8000)]
    adopt_configuration(udp, wanted)
    assert read_configuration(udp) == read_configuration(wanted)
    assert [udp[each.index] for each in same] == same
    adopt_configuration(udp, udp.blank())
    assert read_configuration(udp) == read_configuration(udp.blank())


def test_rights_that_the_configuration_grants_are_restored(udp):
    sender(udp)
    write(udp, 0x8000, FrameSub.CHANGEABLE, 1)
    other = copy(udp)
    write(other, 0x8000, FrameSub.DESTINATION_IP, b"\1\2\3\4", OP)
    restore_configuration(other, read_configuration(sender(EapDictionary(BLANK, "eap0"))))
    with pytest.raises(SdoAbortError) as caught:
        write(other, 0x8000, FrameSub.DESTINATION_IP, b"\1\2\3\4", OP)
    assert caught.value.code == AbortCode.DEVICE_STATE


@pytest.mark.parametrize(
    ("code", "kept"),
    [
        (AbortCode.NO_OBJECT, {0x5000: {0: b"\0"}}),
        (AbortCode.NO_SUBINDEX, {0xD000: {99: b"\0"}}),
        (AbortCode.NO_SUBINDEX, {0x1A00: {255: bytes(4)}}),
        (AbortCode.READ_ONLY, {0xD000: {Tx.PDO_LENGTH: b"\0\0"}}),
        (AbortCode.READ_ONLY, {0x1018: {1: bytes(4)}}),
        (AbortCode.TOO_SHORT, {0xD000: {Tx.PD_ID: b"\0"}}),
        (AbortCode.TOO_HIGH, {0xF810: {9: b"\x02"}}),
        (AbortCode.VALUE, {0x6000: {Var.NAME: b"a b"}}),
        (AbortCode.VALUE, {0x6000: {Var.TYPE_NAME: b"u16"}}),
        (AbortCode.VALUE, {0x1A00: {0: b"\x05", 1: bytes(4)}}),
        (AbortCode.VALUE, {0x8000: {0: b"\x20"}}),
    ],
)
def test_unknown_entries_are_refused_and_change_nothing(udp, code, kept):
    sender(udp)
    before = read_configuration(udp)
    with pytest.raises(SdoAbortError) as caught:
        restore_configuration(udp, {0x6000: {Var.NAME: b"fine"}, **kept})
    assert caught.value.code == code
    assert read_configuration(udp) == before


_STORED = {"version": VERSION, "profile": 1000, "objects": {}}


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        ([], "no stored configuration"),
        ({"version": VERSION}, "no stored configuration"),
        (
            _STORED | {"version": VERSION + 1},
            f"version {VERSION + 1}, this release knows {VERSION}",
        ),
        (_STORED | {"profile": 9000}, "profile 9000, this is 1000"),
        (_STORED | {"objects": {"x": {}}}, "no stored configuration"),
        (_STORED | {"objects": {"6000": {"5": "0"}}}, "no stored"),
        (_STORED | {"objects": {"5000": {"0": "00"}}}, "does not exist"),
        (_STORED | {"more": 1}, "no stored configuration"),
    ],
)
def test_invalid_stored_configuration_is_refused_with_reason(udp, data, reason):
    sender(udp)
    before = dump_configuration(udp)
    with pytest.raises(StoredError, match=reason):
        load_configuration(udp, data)
    assert dump_configuration(udp) == before


def test_the_plain_form_is_for_json(udp):
    variable(udp, 0x6000, "level")
    plain = dump_configuration(udp)
    assert plain["objects"]["6000"]["5"] == b"level".hex()
    other = EapDictionary(BLANK, "eap0")
    load_configuration(other, plain)
    assert other.upload(0x6000, Var.NAME, OdState.OP) == b"level"


def _without_empty_mappings(dictionary):
    return {
        index: entries
        for index, entries in read_configuration(dictionary).items()
        if not (0x1600 <= index <= 0x3DFF and entries == {0: b"\0"})
    }


@examples(30)
@given(stations(), stations())
def test_changes_written_in_their_order_make_the_new_dictionary(
    before: StationSpec, after: StationSpec
):
    for like in (None, filled(before)):
        new = filled(after, like)
        for name, old in filled(before).items():
            for change in compare(old, new[name]):
                old.download(change.index, change.subindex, change.data, OdState.PREOP)
            assert _without_empty_mappings(old) == _without_empty_mappings(new[name])
            assert compare(old, new[name]) == []


@examples(30)
@given(stations())
def test_a_blank_station_is_filled_by_downloads_alone(station: StationSpec):
    for name, new in filled(station).items():
        old = empty()[name]
        for change in compare(old, new):
            assert not change.interim
            old.download(change.index, change.subindex, change.data, OdState.PREOP)
        assert read_configuration(old) == read_configuration(new)


@examples(30)
@given(stations())
def test_a_copy_does_not_differ(station: StationSpec):
    for each in filled(station).values():
        assert compare(each, copy(each)) == []


def _told(old, new) -> list[tuple[str, str, str, str, bool]]:
    return [(c.kind, c.name, c.old, c.new, c.interim) for c in compare(old, new)]


def test_changed_entry_has_names_and_values(udp):
    sender(udp)
    new = copy(udp)
    write(new, 0xD000, Tx.CYCLE_TIME, 20_000)
    write(new, 0x8000, FrameSub.DESTINATION_IP, b"\x0a\0\0\3")
    write(new, 0xF800, 8, 5000)
    assert _told(udp, new) == [
        ("changed", "Configured objects: Device cycle time", "10000", "5000", False),
        ("changed", "TxPD 0 (txpd0): Cycle time", "0", "20000", False),
        ("changed", "TxFrame 0 (frame0): Destination IP", "10.0.0.2", "10.0.0.3", False),
    ]


def test_a_variable_more_in_a_pd_empties_its_mapping_first(udp):
    sender(udp)
    new = copy(udp)
    variable(new, 0x6001, "more", "REAL")
    mapping(new, 0x1A00, (0x6000, 16), (0x6001, 32))
    assert _told(udp, new) == [
        ("changed", "TxPDO mapping 0: number of entries", "1", "0", True),
        ("added", "Tx variable 1 (more): Type name", "", "REAL", False),
        ("added", "Tx variable 1 (more): Name", "", "more", False),
        ("changed", "TxPDO mapping 0: Mapping 0", "0x6000:01/16", "0x6000:01/16", True),
        ("added", "TxPDO mapping 0: Mapping 1", "", "0x6001:01/32", False),
        ("changed", "TxPDO mapping 0: number of entries", "1", "2", False),
    ]


def test_removed_objects_are_deleted_after_their_references(udp):
    sender(udp)
    assert _told(udp, udp.blank()) == [
        ("removed", "TxFrame 0 (frame0)", str(FrameSub.TXPD.value), "", False),
        ("removed", "TxPDO mapping 0", "1", "", False),
        ("removed", "TxPD 0 (txpd0)", str(TX_PD.fixed_count), "", False),
        ("removed", "Tx variable 0 (level)", str(TX_VARIABLE.fixed_count), "", False),
    ]


def test_a_pd_more_in_a_frame_goes_to_the_end_of_its_list(udp):
    sender(udp)
    new = copy(udp)
    write(new, 0x8000, FrameSub.TXPD + 1, tx_pd(new, 0xD001, 0x1A00, 2))
    changes = [change for change in compare(udp, new) if change.index == 0x8000]
    assert [(c.kind, c.subindex, c.new) for c in changes] == [
        ("added", FrameSub.TXPD + 1, "0xD001")
    ]


def test_pds_that_change_their_places_leave_the_frame_first(udp):
    sender(udp)
    write(udp, 0x8000, FrameSub.TXPD + 1, tx_pd(udp, 0xD001, 0x1A00, 2))
    new = copy(udp)
    write(new, 0x8000, FrameSub.TXPD, 0xD001)
    write(new, 0x8000, FrameSub.TXPD + 1, 0xD000)
    assert [(c.subindex, c.new, c.interim) for c in compare(udp, new)] == [
        (0, str(FrameSub.TXPD - 1), True),
        (FrameSub.TXPD, "0xD001", False),
        (FrameSub.TXPD + 1, "0xD000", False),
    ]


def test_pds_that_refer_to_each_other_are_cleared_before_removal(udp):
    receiver(sender(udp))
    write(udp, 0xD000, Tx.POLL_REQUEST_RXPD, 0xE000)
    write(udp, 0xE000, Rx.POLL_REQUEST_TXPD, 0xD000)
    changes = compare(udp, udp.blank())
    assert [(c.index, c.subindex) for c in changes if c.interim] == [
        (0xD000, Tx.POLL_REQUEST_RXPD),
        (0xE000, Rx.POLL_REQUEST_TXPD),
    ]
    for change in changes:
        write(udp, change.index, change.subindex, change.data)
    assert not udp.members(TX_PD, RX_PD)


def test_a_default_that_a_variable_keeps_with_another_type_is_no_change_to_people(udp):
    variable(udp, 0x6000, "level")
    new = copy(udp)
    write(new, 0x6000, Var.TYPE_NAME, "UDINT")
    for dictionary, octets in ((udp, b"\x32\0"), (new, b"\x32\0\0\0")):
        write(dictionary, 0x6000, Var.DEFAULT_GIVEN, 1)
        write(dictionary, 0x6000, Var.DEFAULT, octets)
    assert [(c.subindex, c.old, c.new, c.interim) for c in compare(udp, new)] == [
        (Var.TYPE_NAME, "UINT", "UDINT", False),
        (Var.DEFAULT_GIVEN, "true", "true", True),
        (Var.DEFAULT, "50", "50", True),
    ]


def test_a_mapping_that_is_empty_is_as_good_as_none(udp):
    new = copy(udp)
    write(new, 0x1A00, 0, 0)
    assert compare(udp, new) == []
    assert compare(new, udp) == []
