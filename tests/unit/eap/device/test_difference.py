from __future__ import annotations

from hypothesis import given

from eap.device.difference import compare
from eap.device.stored import configuration
from eap.od.model import OdState
from eap.od.profiles.eap1000 import RX_PD, TX_PD, FrameSub, Rx, Tx, Var
from eap.pd.spec import StationSpec
from tests.support.downloads import copy, mapping, receiver, sender, tx_pd, variable, write
from tests.support.examples import examples
from tests.support.stations import empty, filled, stations


def _kept(dictionary):
    return {
        index: entries
        for index, entries in configuration(dictionary).items()
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
            assert _kept(old) == _kept(new[name])
            assert compare(old, new[name]) == []


@examples(30)
@given(stations())
def test_a_blank_station_is_filled_by_downloads_alone(station: StationSpec):
    for name, new in filled(station).items():
        old = empty()[name]
        for change in compare(old, new):
            assert not change.interim
            old.download(change.index, change.subindex, change.data, OdState.PREOP)
        assert configuration(old) == configuration(new)


@examples(30)
@given(stations())
def test_a_copy_does_not_differ(station: StationSpec):
    for each in filled(station).values():
        assert compare(each, copy(each)) == []


def _told(old, new) -> list[tuple[str, str, str, str, bool]]:
    return [(c.kind, c.name, c.old, c.new, c.interim) for c in compare(old, new)]


def test_a_changed_entry_is_told_by_names_and_values(udp):
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


def test_what_is_no_longer_there_is_removed_from_the_outside_in(udp):
    sender(udp)
    assert _told(udp, udp.blank()) == [
        ("removed", "TxFrame 0 (frame0)", "16", "", False),
        ("removed", "TxPDO mapping 0", "1", "", False),
        ("removed", "TxPD 0 (txpd0)", "18", "", False),
        ("removed", "Tx variable 0 (level)", "10", "", False),
    ]


def test_a_pd_more_in_a_frame_goes_to_the_end_of_its_list(udp):
    sender(udp)
    new = copy(udp)
    write(new, 0x8000, FrameSub.TXPD + 1, tx_pd(new, 0xD001, 0x1A00, 2))
    changes = [change for change in compare(udp, new) if change.index == 0x8000]
    assert [(c.kind, c.subindex, c.new) for c in changes] == [("added", 17, "0xD001")]


def test_pds_that_change_their_places_leave_the_frame_first(udp):
    sender(udp)
    write(udp, 0x8000, FrameSub.TXPD + 1, tx_pd(udp, 0xD001, 0x1A00, 2))
    new = copy(udp)
    write(new, 0x8000, FrameSub.TXPD, 0xD001)
    write(new, 0x8000, FrameSub.TXPD + 1, 0xD000)
    assert [(c.subindex, c.new, c.interim) for c in compare(udp, new)] == [
        (0, "15", True),
        (16, "0xD001", False),
        (17, "0xD000", False),
    ]


def test_pds_that_refer_to_each_other_are_let_go_before_both_go(udp):
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
