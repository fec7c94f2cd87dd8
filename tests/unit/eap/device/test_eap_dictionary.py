from __future__ import annotations

import struct

import pytest

from eap.device.eap_dictionary import EapDictionary
from eap.device.stored import configuration
from eap.od import info
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import OdState
from eap.od.profiles.eap1000 import AddressMode, FrameSub, Rx, Tx, Var
from eap.pd.device import DeviceFault, FaultCode
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


def _refused(dictionary: EapDictionary, code: AbortCode, *where, state: OdState = PREOP) -> str:
    """Check that a download is refused with *code* and changes nothing; return the reason."""
    before = configuration(dictionary)
    with pytest.raises(SdoAbortError) as caught:
        write(dictionary, *where, state)
    assert caught.value.code == code, str(caught.value)
    assert configuration(dictionary) == before
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
    assert udp[0x8000].max_subindex == 18
    assert udp.upload(0x8000, FrameSub.TXPD, PREOP) == b"\0\0"
    write(udp, 0x8000, 0, 16)
    assert max(udp[0x8000].entries) == 16


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
        (AbortCode.VALUE, (0x8000, 0, 14)),
        (AbortCode.VALUE, (0xE000, Rx.FLAGS, 0x82)),
        (AbortCode.VALUE, (0xF200, 1, 1)),
        (AbortCode.VALUE, (0xF811, 1, "10.0.0.1")),
    ],
)
def test_what_cannot_be_written_is_refused_by_its_code(udp, code, where):
    sender(udp)
    write(udp, 0x1A00, 0, 0)
    write(udp, 0x1A00, 1, 0x6000_0110)
    _refused(udp, code, *where)


def test_entries_of_a_mapping_in_force_are_refused_until_it_is_empty(udp):
    sender(udp)
    _refused(udp, AbortCode.SUBINDEX_0_NOT_ZERO, 0x1A00, 1, 0x6000_0110)


def test_referred_objects_stay(udp):
    sender(udp)
    assert "0x8000:10 refers" in _refused(udp, AbortCode.PARAMETER, 0xD000, 0, 0)
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


def test_what_an_object_says_to_be_changeable_is_written_in_op(udp):
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


def test_nobody_has_to_want_to_know(udp):
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


def test_a_state_is_asked_for_in_any_state(udp):
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
        assert f"{largest + 1} octets" in reason


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
    assert "frame0 would have 1630 octets, at most 1472 go there" in reason


def test_a_pd_that_grows_beyond_its_frame_is_refused_where_it_grows(udp):
    two_large_pds(udp)
    write(udp, 0x1A01, 0, 0)
    frame(udp, 0x8000, 0xD000, 0xD001)
    write(udp, 0x1A01, 1, 0x6001_01FF)
    _refused(udp, AbortCode.PDO_LENGTH, 0x1A01, 0, 1)
    write(udp, 0xD001, Tx.PDO_INDEX, 0)
    _refused(udp, AbortCode.PDO_LENGTH, 0xD001, Tx.PDO_INDEX, 0x1A00)


def test_a_long_frame_stays_with_the_way_that_takes_it(udp):
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
