from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from msgspec.structs import replace

from eap.codec import datatypes
from eap.device.configuration import read_configuration
from eap.device.eap_dictionary import DeviceIdentity, EapDictionary, NoLiveValues
from eap.device.rollout import bus_variables
from eap.ids import InterfaceUri, NetId
from eap.od import info, model
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import Access, ObjectCode, OdState
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import MAX_ENTRIES, MORE_TX_PDO, AddressMode, FrameSub, Rx, Tx, Var
from eap.od.profiles.eap1000_keys import EapLive
from eap.pd.device import DeviceFault, FaultCode
from eap.pd.spec import PortKind, PortSpec, VariableSpec
from tests.support.downloads import (
    OP,
    PREOP,
    SAFEOP,
    frame,
    mapping,
    receiver,
    sender,
    tx_pd,
    variable,
    write,
)
from tests.support.stations import BLANK


def _refused(dictionary: EapDictionary, code: AbortCode, *where, state: OdState = PREOP) -> str:
    """Check that a download is refused with *code* and changes nothing; return the reason."""
    before = read_configuration(dictionary)
    with pytest.raises(SdoAbortError) as caught:
        write(dictionary, *where, state)
    assert caught.value.code == code, str(caught.value)
    assert read_configuration(dictionary) == before
    return str(caught.value)


def test_any_subindex_makes_an_object_with_defaults(udp):
    write(udp, 0x6005, Var.UNIT, "degC")
    entries = udp[0x6005].entries
    assert entries[Var.UNIT].value == "degC"
    assert entries[Var.NAME].value == "tx-variable5"
    assert entries[Var.TYPE_NAME].value == "UINT"
    assert entries[Var.BIT_LENGTH].value == 16


def test_a_new_object_brings_the_one_that_shows_what_becomes_of_it(udp):
    write(udp, 0xD003, Tx.PD_ID, 7)
    assert udp[0xB003].name == "TxPD diagnosis 3"
    write(udp, 0xD003, 0, 0)
    assert 0xB003 not in udp
    assert 0xD003 not in udp


def test_zero_empties_a_mapping_which_stays(udp):
    sender(udp)
    write(udp, 0x1A00, 0, 0)
    assert udp.upload(0x1A00, 0, PREOP) == b"\0"
    assert list(udp[0x1A00].entries) == [0]


def test_a_list_grows_by_writing_behind_its_end_and_shrinks_by_its_count(udp):
    write(udp, 0x8000, FrameSub.TXPD + 2, 0xD002)
    assert udp[0x8000].max_subindex == FrameSub.TXPD + 2
    assert udp.upload(0x8000, FrameSub.TXPD, PREOP) == b"\0\0"
    write(udp, 0x8000, 0, FrameSub.TXPD)
    assert max(udp[0x8000].entries) == FrameSub.TXPD


@pytest.mark.parametrize(
    ("code", "where"),
    [
        (AbortCode.NO_OBJECT, (0x5000, 1, b"\0")),
        (AbortCode.NO_OBJECT, (0x6001, 0, b"\0")),
        (AbortCode.NO_OBJECT, (0x1A00, 2, 0x6099_0110)),
        (AbortCode.NO_SUBINDEX, (0x6000, 11, b"\0")),
        (AbortCode.NO_SUBINDEX, (0x6001, 99, b"\0")),
        (AbortCode.NO_SUBINDEX, (0x8000, 255, b"\0\0")),
        (AbortCode.NO_SUBINDEX, (0x1A00, 2, 0x6000_0F10)),
        (AbortCode.NO_SUBINDEX, (0x1A00, 0, 9)),
        (AbortCode.READ_ONLY, (0x6000, Var.VALUE, 1)),
        (AbortCode.READ_ONLY, (0x6001, Var.VALUE, 1)),
        (AbortCode.READ_ONLY, (0x1018, 1, 1)),
        (AbortCode.READ_ONLY, (0xF800, 1, 1)),
        (AbortCode.NOT_MAPPABLE, (0x1A00, 2, 0x6000_0510)),
        (AbortCode.NOT_MAPPABLE, (0x1601, 1, 0x6000_0110)),
        (AbortCode.NOT_MAPPABLE, (0x1A00, 2, 0x0000_0009)),
        (AbortCode.LENGTH, (0x1A00, 2, 0x6000_0108)),
        (AbortCode.MAPPED, (0x6000, 0, 0)),
        (AbortCode.MAPPED, (0x6000, Var.TYPE_NAME, "UDINT")),
        (AbortCode.PARAMETER, (0xD000, 0, 0)),
        (AbortCode.TOO_LONG, (0xD000, Tx.PD_ID, b"\0\0\0")),
        (AbortCode.TOO_SHORT, (0xD000, Tx.PD_ID, b"\0")),
        (AbortCode.TOO_LONG, (0x6000, Var.UNIT, "u" * 256)),
        (AbortCode.TOO_HIGH, (0x8000, FrameSub.ADDRESS_MODE, 5)),
        (AbortCode.TOO_HIGH, (0xF800, 8, 60_000_001)),
        (AbortCode.TOO_LOW, (0xF800, 8, 99)),
        (AbortCode.VALUE, (0x6000, Var.NAME, "two words")),
        (AbortCode.VALUE, (0x6000, Var.NAME, b"")),
        (AbortCode.VALUE, (0x6000, Var.NAME, b"\xff")),
        (AbortCode.VALUE, (0x6000, Var.NAME, "state.VarCtrl")),
        (AbortCode.VALUE, (0x6001, Var.TYPE_NAME, "WORT")),
        (AbortCode.VALUE, (0xD000, Tx.PDO_INDEX, 0x1600)),
        (AbortCode.VALUE, (0x8000, FrameSub.TXPD, 0xE000)),
        (AbortCode.VALUE, (0x8000, 0, FrameSub.TXPD - 2)),
        (AbortCode.VALUE, (0xE000, Rx.FLAGS, 0x82)),
        (AbortCode.VALUE, (0xF200, 1, 1)),
        (AbortCode.VALUE, (0xF811, 1, "10.0.0.1")),
    ],
)
def test_invalid_write_is_refused_with_abort_code(udp, code, where):
    sender(udp)
    write(udp, 0x1A00, 0, 0)
    write(udp, 0x1A00, 1, 0x6000_0110)
    _refused(udp, code, *where)


def test_entries_of_a_mapping_in_force_are_refused_until_it_is_empty(udp):
    sender(udp)
    _refused(udp, AbortCode.SUBINDEX_0_NOT_ZERO, 0x1A00, 1, 0x6000_0110)


def test_referred_objects_stay(udp):
    sender(udp)
    refused = _refused(udp, AbortCode.PARAMETER, 0xD000, 0, 0)
    assert f"0x8000:{FrameSub.TXPD:02X} refers" in refused
    assert "0x1A00:01 refers" in _refused(udp, AbortCode.MAPPED, 0x6000, 0, 0)
    receiver(udp)
    write(udp, 0xD000, Tx.POLL_REQUEST_RXPD, 0xE000)
    assert "0xD000:0A refers" in _refused(udp, AbortCode.PARAMETER, 0xE000, 0, 0)
    write(udp, 0x8000, FrameSub.TXPD, 0)
    write(udp, 0xE000, Rx.POLL_REQUEST_TXPD, 0xD000)
    assert "0xE000:07 refers" in _refused(udp, AbortCode.PARAMETER, 0xD000, 0, 0)


@pytest.mark.parametrize("state", [SAFEOP, OP])
def test_configuration_is_written_in_preop_only(udp, state):
    sender(udp)
    for where in (
        (0x6000, Var.NAME, "x"),
        (0x6000, 0, 0),
        (0x6001, Var.NAME, "new"),
        (0x1A00, 0, 0),
        (0x1A00, 1, 0x6000_0110),
        (0xD000, Tx.CYCLE_TIME, 1000),
        (0x8000, FrameSub.TXPD + 1, 0xD000),
        (0xF800, 8, 1000),
        (0xF811, 1, "239.1.1.1"),
    ):
        _refused(udp, AbortCode.DEVICE_STATE, *where, state=state)
    with pytest.raises(SdoAbortError) as caught:
        udp.download_complete(0x6001, 1, b"", state)
    assert caught.value.code == AbortCode.DEVICE_STATE


def test_download_writes_changeable_entry_in_op(udp):
    sender(udp)
    told: list[tuple[int, int]] = []
    udp.on_change = lambda index, subindex: told.append((index, subindex))
    write(udp, 0x8000, FrameSub.CHANGEABLE, 1)
    write(udp, 0x8000, FrameSub.DESTINATION_IP, b"\x0a\0\0\3", OP)
    assert told == [(0x8000, FrameSub.DESTINATION_IP)]
    _refused(udp, AbortCode.DEVICE_STATE, 0x8000, FrameSub.DIVIDER, 2, state=OP)
    write(udp, 0x8000, FrameSub.CHANGEABLE, 0)
    _refused(udp, AbortCode.DEVICE_STATE, 0x8000, FrameSub.PORT_NUMBER, 2, state=OP)


def test_a_change_in_op_that_cannot_run_is_taken_back(udp):
    sender(udp)
    write(udp, 0xD000, Tx.CHANGEABLE, 1)

    def refuse(index: int, subindex: int) -> None:
        raise DeviceFault(FaultCode.PD_ID_TWICE, "7", index, subindex)

    udp.on_change = refuse
    assert "PD ID is used twice" in _refused(
        udp, AbortCode.PARAMETER, 0xD000, Tx.PD_ID, 7, state=OP
    )


def test_state_machine_works_without_callbacks(udp):
    sender(udp)
    write(udp, 0x8000, FrameSub.CHANGEABLE, 1)
    write(udp, 0x8000, FrameSub.PORT_NUMBER, 7, OP)
    write(udp, 0xF200, 1, 8)
    assert udp.upload(0x8000, FrameSub.PORT_NUMBER, OP) == b"\7\0"


class TestInformation:
    @pytest.mark.parametrize(
        ("kind", "indexes"),
        [
            (info.ListType.TX_MAPPABLE, [0x6000, 0x7000]),
            (info.ListType.RX_MAPPABLE, [0x7000]),
            (
                info.ListType.BACKUP,
                [0x1600, 0x1A00, 0x6000, 0x7000, 0x8000, 0xD000, 0xE000, 0xF800, 0xF810, 0xF811],
            ),
            (info.ListType.SETTINGS, []),
        ],
    )
    def test_lists_name_the_objects_that_there_are(self, udp, kind, indexes):
        receiver(sender(udp))
        octets = info.object_list(udp, kind)
        assert list(struct.unpack(f"<{len(octets) // 2}H", octets))[1:] == indexes

    def test_every_object_and_entry_is_described(self, udp):
        receiver(sender(udp))
        everything = info.object_list(udp, info.ListType.ALL)
        indexes = struct.unpack(f"<{len(everything) // 2}H", everything)[1:]
        assert list(indexes) == [item.index for item in udp]
        for index in indexes:
            assert info.object_description(udp, index)[6:] == udp[index].name.encode()
            for subindex, entry in udp[index].entries.items():
                described = info.entry_description(udp, index, subindex, 0x7F)
                assert described.endswith(entry.name.encode())
                assert entry.name

    def test_a_cycle_time_has_a_unit_and_limits(self, udp):
        described = info.entry_description(udp, 0xF800, 8, 0x78)
        assert described[3] & 0x78 == 0x78
        assert described[10:] == struct.pack("<4I", 0xFA030000, 10_000, 100, 60_000_000) + (
            b"Device cycle time"
        )


def test_state_can_be_requested_in_any_state(udp):
    asked: list[int] = []
    udp.on_request = asked.append
    for state, wanted in ((PREOP, 4), (SAFEOP, 8), (OP, 2)):
        write(udp, 0xF200, 1, wanted, state)
    assert asked == [4, 8, 2]


def test_a_pdo_that_is_too_long_for_any_frame_is_refused_at_the_mapping(udp, ethernet):
    for dictionary, largest in ((ethernet, 1478), (udp, 2027)):
        variable(dictionary, 0x6000, "block", f"BLOCK({largest})")
        mapping(dictionary, 0x1A00, (0x6000, 255))
        variable(dictionary, 0x6001, "bit", "BOOL")
        mapping(dictionary, 0x1A01, (0x6001, 1))
        write(dictionary, 0x1A01, 0, 0)
        write(dictionary, 0x1A01, 1, 0x6001_0101)
        write(dictionary, 0x1A01, 2, 0x0000_0007)
        write(dictionary, 0x1A01, 3, 0x6000_01FF)
        reason = _refused(dictionary, AbortCode.PDO_LENGTH, 0x1A01, 0, 3)
        assert f"{largest + 1} bytes" in reason


def test_padding_has_to_be_where_bits_end_and_nowhere_else(udp):
    variable(udp, 0x6000, "bit", "BOOL")
    variable(udp, 0x6001, "word", "UINT")
    for words in (
        [0x6000_0101, 0x6001_0110],
        [0x6000_0101, 0x0000_0003, 0x6001_0110],
        [0x0000_0003, 0x6000_0101],
        [0x6001_0110, 0x0000_0007],
    ):
        write(udp, 0x1A00, 0, 0)
        for subindex, word in enumerate(words, 1):
            write(udp, 0x1A00, subindex, word)
        _refused(udp, AbortCode.PARAMETER, 0x1A00, 0, len(words))


def two_large_pds(dictionary: EapDictionary) -> None:
    for number in range(2):
        variable(dictionary, 0x6000 + number, f"block{number}", "BLOCK(800)")
        mapping(dictionary, 0x1A00 + number, (0x6000 + number, 255))
        tx_pd(dictionary, 0xD000 + number, 0x1A00 + number, number)


def test_a_pd_for_which_a_frame_has_no_room_is_refused_in_its_list(udp):
    two_large_pds(udp)
    frame(udp, 0x8000, 0xD000)
    reason = _refused(udp, AbortCode.PDO_LENGTH, 0x8000, FrameSub.TXPD + 1, 0xD001)
    assert "frame0 would have 1630 bytes, at most 1472 fit its destination" in reason


def test_a_pd_that_grows_beyond_its_frame_is_refused_where_it_grows(udp):
    two_large_pds(udp)
    write(udp, 0x1A01, 0, 0)
    frame(udp, 0x8000, 0xD000, 0xD001)
    write(udp, 0x1A01, 1, 0x6001_01FF)
    _refused(udp, AbortCode.PDO_LENGTH, 0x1A01, 0, 1)
    write(udp, 0xD001, Tx.PDO_INDEX, 0)
    _refused(udp, AbortCode.PDO_LENGTH, 0xD001, Tx.PDO_INDEX, 0x1A00)


def test_long_frame_keeps_its_address_mode(udp):
    two_large_pds(udp)
    write(udp, 0x8000, FrameSub.ADDRESS_MODE, AddressMode.TCP)
    for number in range(2):
        write(udp, 0x8000, FrameSub.TXPD + number, 0xD000 + number)
    _refused(udp, AbortCode.PDO_LENGTH, 0x8000, FrameSub.ADDRESS_MODE, AddressMode.IP)


def test_a_new_type_forgets_the_default(udp):
    variable(udp, 0x6000, "level", "UINT")
    write(udp, 0x6000, Var.DEFAULT, 7)
    write(udp, 0x6000, Var.DEFAULT_GIVEN, 1)
    write(udp, 0x6000, Var.TYPE_NAME, "u16")  # the same one
    assert udp[0x6000].entries[Var.DEFAULT].value == 7
    write(udp, 0x6000, Var.TYPE_NAME, "real")
    assert udp.upload(0x6000, Var.TYPE_NAME, PREOP) == b"REAL"
    assert udp.upload(0x6000, Var.DEFAULT, PREOP) == bytes(4)
    assert udp.upload(0x6000, Var.DEFAULT_GIVEN, PREOP) == b"\0"
    assert udp.upload(0x6000, Var.BIT_LENGTH, PREOP) == b"\x20\0\0\0"


def test_status_is_shown(udp):
    udp.show_status(0x12, DeviceFault(FaultCode.NO_PDO, "état" * 300, 0xD000, 1))
    assert udp.upload(0xF100, 1, OP) == b"\x12\0"
    assert udp.upload(0xF100, 2, OP) == struct.pack("<H", FaultCode.NO_PDO)
    assert udp.upload(0xF100, 3, OP).startswith(b"0xD000:01: PD has no PDO: ")
    assert len(udp.upload(0xF100, 3, OP)) == 1000
    assert udp.upload(0xF100, 4, OP) == b"\x00\x01\x00\xd0"
    udp.show_status(2, None)
    assert udp.upload(0xF100, 3, OP) == b""


class TestCompleteAccess:
    def test_a_mapping_is_written_whole(self, udp):
        variable(udp, 0x6000, "level")
        data = struct.pack("<H2I", 2, 0x6000_0110, 0x6000_0110)
        udp.download_complete(0x1A05, 0, data, PREOP)
        assert udp.upload_complete(0x1A05, 0, PREOP) == data
        udp.download_complete(0x1A05, 0, struct.pack("<HI", 1, 0x6000_0110), PREOP)
        assert udp[0x1A05].max_subindex == 1

    def test_partly_invalid_download_changes_nothing(self, udp):
        sender(udp)
        before = read_configuration(udp)
        data = struct.pack("<H2I", 2, 0x6000_0110, 0x6001_0110)
        for index in (0x1A00, 0x1A01):
            with pytest.raises(SdoAbortError) as caught:
                udp.download_complete(index, 0, data, PREOP)
            assert caught.value.code == AbortCode.NO_OBJECT
            assert read_configuration(udp) == before

    def test_zero_deletes_an_object_and_empties_a_mapping(self, udp):
        sender(udp)
        udp.download_complete(0x8000, 0, b"\0\0", PREOP)
        udp.download_complete(0x1A00, 0, b"\0\0", PREOP)
        assert 0x8000 not in udp
        assert udp[0x1A00].max_subindex == 0

    def test_a_frame_comes_back_as_it_was_read(self, udp):
        sender(udp)
        data = udp.upload_complete(0x8000, 0, PREOP)
        write(udp, 0x8000, 0, 0)
        udp.download_complete(0x8000, 0, data, PREOP)
        assert udp.upload_complete(0x8000, 0, PREOP) == data

    @pytest.mark.parametrize(
        ("code", "where", "state"),
        [
            (AbortCode.NO_COMPLETE_ACCESS, (0x1000, 0, b""), PREOP),
            (AbortCode.UNSUPPORTED_ACCESS, (0xD000, 2, b""), PREOP),
            (AbortCode.TOO_SHORT, (0xD000, 0, b"\0"), PREOP),
            (AbortCode.TOO_SHORT, (0xD000, 1, b"\0"), PREOP),
            (AbortCode.TOO_LONG, (0xD000, 1, bytes(2000)), PREOP),
            (AbortCode.TOO_LONG, (0x8000, 0, bytes(20)), PREOP),
            (AbortCode.VALUE, (0x8000, 0, b"\xff\0"), PREOP),
            (AbortCode.READ_ONLY, (0x1018, 1, bytes(16)), PREOP),
            (AbortCode.DEVICE_STATE, (0xF811, 0, b"\0\0"), OP),
            (AbortCode.NO_OBJECT, (0x5000, 0, b"\0\0"), PREOP),
        ],
    )
    def test_refusals(self, udp, code, where, state):
        sender(udp)
        before = read_configuration(udp)
        with pytest.raises(SdoAbortError) as caught:
            udp.download_complete(*where, state)
        assert caught.value.code == code
        assert read_configuration(udp) == before

    def test_a_whole_frame_that_is_too_long_is_refused(self, udp):
        two_large_pds(udp)
        write(udp, 0x8000, FrameSub.ADDRESS_MODE, AddressMode.TCP)
        for number in range(2):
            write(udp, 0x8000, FrameSub.TXPD + number, 0xD000 + number)
        data = bytearray(udp.upload_complete(0x8000, 0, PREOP))
        data[3] = AddressMode.IP  # behind sub-index 0 and Enabled
        with pytest.raises(SdoAbortError) as caught:
            udp.download_complete(0x8000, 0, bytes(data), PREOP)
        assert caught.value.code == AbortCode.PDO_LENGTH


class TestBeforeTheDataIsThere:
    def test_valid_download_is_accepted(self, udp):
        udp.check_download(0x1A00, 0, 2 + 4 * 254, PREOP, complete=True)
        udp.check_download(0x1A00, 254, 4, PREOP)
        udp.check_download(0x6000, Var.NAME, 255, PREOP)
        udp.check_download(0xF811, 17, 17, PREOP)
        udp.check_download(0xF800, 8, 4, PREOP)
        assert 0x1A00 not in udp

    @pytest.mark.parametrize(
        ("code", "where", "state"),
        [
            (AbortCode.NO_OBJECT, (0x5000, 1, 4), PREOP),
            (AbortCode.DEVICE_STATE, (0x6009, Var.NAME, 4), OP),
            (AbortCode.DEVICE_STATE, (0x6000, Var.NAME, 4), OP),
            (AbortCode.TOO_LONG, (0x6000, Var.NAME, 256), PREOP),
            (AbortCode.NO_SUBINDEX, (0x1A00, 255, 4), PREOP),
            (AbortCode.READ_ONLY, (0x1000, 0, 4), PREOP),
        ],
    )
    def test_invalid_download_is_refused(self, udp, code, where, state):
        variable(udp, 0x6000, "level")
        with pytest.raises(SdoAbortError) as caught:
            udp.check_download(*where, state)
        assert caught.value.code == code

    def test_check_download_accepts_changeable_entry_in_op(self, udp):
        sender(udp)
        write(udp, 0x8000, FrameSub.CHANGEABLE, 1)
        udp.check_download(0x8000, FrameSub.DESTINATION_MAC, 6, OP)
        with pytest.raises(SdoAbortError) as caught:
            udp.check_download(0x8000, FrameSub.NAME, 6, OP)
        assert caught.value.code == AbortCode.DEVICE_STATE

    def test_the_default_of_a_variable_is_as_long_as_its_type(self, udp):
        variable(udp, 0x6000, "level", "BLOCK(900)")
        udp.check_download(0x6000, Var.DEFAULT, 900, PREOP)


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
        udp.add(model.variable(0x5000, "stranger", "UINT"))
    assert caught.value.code == AbortCode.NO_OBJECT


def test_members_are_listed_in_order_of_their_indexes(udp):
    for index in (0x6005, 0x6001, 0x7000):
        udp.make(profile.row_of(index), index)
    assert udp.members(*profile.VARIABLES) == [0x6001, 0x6005, 0x7000]
    udp.remove(0x6005)
    udp.remove(0x6005)
    assert udp.members(profile.TX_VARIABLE) == [0x6001]


def test_a_longest_list_has_names_for_all_entries(udp):
    item = udp.make_object(profile.TX_FRAME, 0x8000, last=MAX_ENTRIES)
    assert item.entries[FrameSub.TXPD].name == "TxPD 0"
    assert item.entries[MAX_ENTRIES].name == f"TxPD {MAX_ENTRIES - FrameSub.TXPD}"
    assert item.max_subindex == MAX_ENTRIES


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
    udp.put(0x8000, FrameSub.CHANGEABLE, b"\1")
    assert item.entries[FrameSub.DESTINATION_IP].access & Access.WRITE_OP
    assert not item.entries[FrameSub.DIVIDER].access & Access.WRITE_OP
    udp.put(0x8000, FrameSub.CHANGEABLE, b"\0")
    assert not item.entries[FrameSub.DESTINATION_IP].access & Access.WRITE_OP


def _read(dictionary: EapDictionary, index: int, subindex: int) -> int:
    return int.from_bytes(dictionary.upload(index, subindex, OdState.OP), "little")


def test_identity_and_port_are_shown(udp, ethernet):
    assert _read(udp, 0x1000, 0) == 0x03E81389
    assert udp.upload(0xF920, 1, PREOP) == bytes((127, 0, 9, 1, 2, 1))
    assert udp.upload(0xF810, 3, PREOP) == b"udp://127.0.9.1"
    assert [_read(each, 0xF810, 2) for each in (udp, ethernet)] == [0, 1]
    assert _read(udp, 0xF000, 1) == 1


def test_identity_can_be_another():
    identity = DeviceIdentity(device_name="oven", vendor=2, serial=77)
    station = replace(BLANK, ports=(replace(BLANK.ports[0], profile=5002), *BLANK.ports[1:]))
    dictionary = EapDictionary(station, "eap0", identity=identity)
    assert _read(dictionary, 0x1000, 0) == 1000 << 16 | 5002
    assert dictionary.upload(0x1008, 0, PREOP) == b"oven"
    assert dictionary.upload_complete(0x1018, 1, PREOP) == struct.pack("<4I", 2, 0, 0, 77)


class Recorder:
    """Live values that tell what they were asked for, and within which moment."""

    def __init__(self) -> None:
        self.moments = 0
        self.is_in_moment = False
        self.seen: list[bool] = []

    @contextmanager
    def consistent_values(self) -> Iterator[None]:
        self.moments += 1
        self.is_in_moment = True
        yield
        self.is_in_moment = False

    def octets(self, key: str, name: str) -> bytes | None:
        self.seen.append(self.is_in_moment)
        return {("value", "level"): b"\x34\x12", ("tx_skipped", "txpd0"): bytes(3)}.get((key, name))


def test_live_entries_show_what_runs_and_zero_when_nothing_does():
    dictionary = sender(EapDictionary(BLANK, "eap0", Recorder()))
    assert _read(dictionary, 0x6000, Var.VALUE) == 0x1234
    assert dictionary.upload(0xB000, 2, OdState.OP) == bytes(8)  # of another size
    assert _read(dictionary, 0xF110, 1) == 0
    variable(dictionary, 0x6001, "other")
    assert _read(dictionary, 0x6001, Var.VALUE) == 0


def test_whole_object_shows_live_entries_of_one_moment():
    live = Recorder()
    dictionary = sender(EapDictionary(BLANK, "eap0", live))
    dictionary.upload_complete(0xB000, 1, OdState.OP)
    assert live.moments == 1
    assert len(live.seen) > 1
    assert all(live.seen)


def test_lengths_counts_and_free_indexes_are_computed(udp):
    assert _read(udp, 0xF801, 2) == 0xD000
    sender(udp)
    receiver(udp)
    write(udp, 0x3000, 1, 0x6000_0110)
    assert _read(udp, 0xD000, Tx.PDO_LENGTH) == 2
    assert _read(udp, 0x8000, FrameSub.FRAME_LENGTH) == 14 + 8 + 2
    assert [_read(udp, 0xF800, sub) for sub in range(1, 8)] == [1, 1, 1, 2, 1, 1, 1]
    assert [_read(udp, 0xF801, sub) for sub in (1, 2, 4)] == [0x8001, 0xD001, 0x1A01]
    write(udp, 0xD000, Tx.PDO_INDEX, 0x1A07)
    assert _read(udp, 0xD000, Tx.PDO_LENGTH) == 0


def test_bits_are_counted_to_whole_octets(udp):
    variable(udp, 0x6000, "bit", "BOOL")
    variable(udp, 0x6001, "word")
    mapping(udp, 0x1A00, (0x6000, 1), (0, 7), (0x6001, 16), (0x6000, 1))
    tx_pd(udp, 0xD000, 0x1A00, 1)
    assert _read(udp, 0xD000, Tx.PDO_LENGTH) == 4


def test_no_free_index_is_left(udp):
    for number in range(512):
        write(udp, 0x1A00 + number, 0, 0)
    assert _read(udp, 0xF801, 4) == 0x3000
    for index in range(0x3000, 0x3E00):
        udp.make(MORE_TX_PDO, index)
    assert _read(udp, 0xF801, 4) == 0


def test_users_of_an_object_are_found(udp):
    sender(udp)
    frame(udp, 0x8001, 0xD005)
    assert udp.reference_to(0x6000) == (0x1A00, 1)
    assert udp.reference_to(0xD000) == (0x8000, FrameSub.TXPD)
    assert udp.reference_to(0x8000) is None
    assert udp.reference_to(0x1A00) is None


def test_names_are_those_of_what_an_object_is_about(udp):
    sender(udp)
    assert [udp.name_of(i) for i in (0x6000, 0xD000, 0xB000, 0x8000, 0xA000, 0x1A00)] == [
        "level", "txpd0", "txpd0", "frame0", "frame0", "",
    ]  # fmt: skip


def test_variables_of_buses_belong_to_no_dictionary():
    bus = PortSpec(
        "bus0", PortKind.BUS, InterfaceUri.parse("sim:///x.yaml"), NetId.parse("127.0.9.1.4.1")
    )
    names = ("bus0.state", "bus0.drive.speed", "busy")
    station = replace(
        BLANK,
        ports=(*BLANK.ports, bus),
        variables=tuple(VariableSpec(name, "UINT") for name in names),
    )
    assert bus_variables(station) == {"bus0.state", "bus0.drive.speed"}


def test_nothing_is_shown_of_what_does_not_run():
    assert {NoLiveValues().octets(key, "any") for key in EapLive} == {None}
