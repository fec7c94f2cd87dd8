from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_rules import (
    MappingEntry,
    check_mapped,
    checked,
    encode_mapping,
    lay_out_mapping,
    mapped_bits,
)
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import Access
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import FrameSub, Rx, Tx, Var
from tests.support.downloads import variable, write
from tests.support.stations import BLANK, TYPES


def _checked(dictionary, row, subindex, data):
    last = row.last_subindex if row.list_row else 0
    entry = dictionary.make_object(row, row.first, last=last).entries[subindex]
    return checked(row, subindex, entry, data)


GROUPS = profile.row_of(0xF811)
CONTROL = profile.row_of(0xF200)


@pytest.mark.parametrize(
    ("row", "subindex", "data", "kept"),
    [
        (profile.TX_VARIABLE, Var.TYPE_NAME, b" u16 ", b"UINT"),
        (profile.TX_VARIABLE, Var.TYPE_NAME, b"REAL[4]\0\0", b"REAL[4]"),
        (profile.TX_VARIABLE, Var.NAME, b"level\0", b"level"),
        (profile.TX_VARIABLE, Var.COMMENT, "größer".encode(), "größer".encode()),
        (profile.TX_PD, Tx.ENABLED, b"\x7f", b"\1"),
        (profile.TX_PD, Tx.PDO_INDEX, b"\x00\x30", b"\x00\x30"),
        (profile.TX_PD, Tx.PDO_INDEX, b"\0\0", b"\0\0"),
        (profile.RX_PD, Rx.FLAGS, b"\x85", b"\x85"),
        (profile.TX_FRAME, FrameSub.TXPD + 3, b"\x05\xd0", b"\x05\xd0"),
        (GROUPS, 9, b"01-00-5E-00-00-01", b"01:00:5e:00:00:01"),
        (GROUPS, 1, b"239.1.2.3", b"239.1.2.3"),
        (GROUPS, 1, b"", b""),
        (CONTROL, 1, b"\x08\0", b"\x08\0"),
    ],
)
def test_values_are_kept_in_their_usual_form(udp, row, subindex, data, kept):
    assert _checked(udp, row, subindex, data) == kept


@pytest.mark.parametrize(
    ("row", "subindex", "data", "reason"),
    [
        (profile.TX_VARIABLE, Var.TYPE_NAME, b"WORT", "did you mean WORD"),
        (profile.RX_VARIABLE, Var.NAME, b"a b", "without spaces"),
        (profile.TX_PD, Tx.NAME, b"a/b", "without spaces and slashes"),
        (profile.TX_VARIABLE, Var.UNIT, b"a\0b", "NUL"),
        (profile.TX_VARIABLE, Var.UNIT, b"\xff", "UTF-8"),
        (profile.TX_PD, Tx.PDO_INDEX, b"\x00\x16", "0x1A00 to 0x1BFF or 0x3000 to 0x3DFF"),
        (profile.RX_PD, Rx.POLL_REQUEST_TXPD, b"\x00\xe0", "0xD000 to 0xDFFF"),
        (profile.TX_FRAME, FrameSub.TXPD, b"\x01\0", "0xD000 to 0xDFFF"),
        (profile.RX_PD, Rx.FLAGS, b"\x08", "of the flags 0x85 only"),
        (GROUPS, 1, b"10.0.0.1", "no multicast address"),
        (GROUPS, 1, b"02:00:00:00:00:01", "no multicast address"),
        (CONTROL, 1, b"\x01\0", "1 cannot be requested"),
        (CONTROL, 1, b"\x03\0", "3 cannot be requested"),
    ],
)
def test_entry_refuses_invalid_value_with_reason(udp, row, subindex, data, reason):
    with pytest.raises(ValueError, match=reason):
        _checked(udp, row, subindex, data)


def test_a_default_is_a_finite_number_and_nothing_beside_its_bits(udp):
    def default(text, data):
        item = udp.make_object(profile.TX_VARIABLE, 0x6000, datatypes.parse(text))
        return checked(profile.TX_VARIABLE, Var.DEFAULT, item.entries[Var.DEFAULT], data)

    assert default("BIT3", b"\xff") == b"\x07"
    assert default("BOOL", b"\x40") == b"\x01"
    assert default("STRING(5)", b"ab\0\0\0") == b"ab"
    for text, data in (
        ("REAL", struct.pack("<f", float("nan"))),
        ("REAL[2]", struct.pack("<2f", 0, float("inf"))),
    ):
        with pytest.raises(ValueError, match="finite"):
            default(text, data)


def test_control_variables_are_the_appliances_own(udp):
    for name in (b"state.VarCtrl", b"frame.FrameCtrl"):
        with pytest.raises(ValueError, match="made by the appliance"):
            _checked(udp, profile.TX_VARIABLE, Var.NAME, name)


@given(st.integers(0, 0xFFFF_FFFF))
def test_an_entry_is_index_subindex_and_length(word):
    mapped = MappingEntry.decode(word)
    assert mapped.encode() == word
    assert (mapped.target, mapped.subindex, mapped.bits) == (
        word >> 16,
        word >> 8 & 255,
        word & 255,
    )


@given(st.lists(st.sampled_from(TYPES), max_size=30))
def test_padding_is_what_the_layout_of_a_pd_leaves_out(texts):
    kinds = [datatypes.parse(text) for text in texts]
    dictionary = EapDictionary(BLANK, "eap0")
    for number, text in enumerate(texts):
        variable(dictionary, 0x6000 + number, f"v{number}", text)
    words = encode_mapping((0x6000 + number, kind) for number, kind in enumerate(kinds))
    for subindex, word in enumerate(words, 1):
        write(dictionary, 0x1A00, subindex, word)
    write(dictionary, 0x1A00, 0, len(words))
    placed = lay_out_mapping(dictionary, 0x1A00, len(words), 65535)
    assert placed.octets == datatypes.layout(kinds).size
    assert placed.indexes == tuple(range(0x6000, 0x6000 + len(texts)))
    assert -(-mapped_bits(dictionary, dictionary[0x1A00]) // 8) == placed.octets


def test_a_mapping_has_254_entries_padding_included():
    bit, word = datatypes.parse("BOOL"), datatypes.parse("UINT")
    assert len(encode_mapping([(0x6000, bit)] * 254)) == 254
    with pytest.raises(ValueError, match="at most 254 entries, this PD needs 258"):
        encode_mapping([(0x6000, bit), (0x6001, word)] * 86)


@pytest.mark.parametrize(
    ("code", "word"),
    [
        (AbortCode.NO_OBJECT, 0x6009_0110),
        (AbortCode.NO_SUBINDEX, 0x6000_2010),
        (AbortCode.NOT_MAPPABLE, 0x6000_0510),
        (AbortCode.NOT_MAPPABLE, 0x0000_0008),
        (AbortCode.NOT_MAPPABLE, 0x0000_0000),
        (AbortCode.NOT_MAPPABLE, 0x0000_0101),
        (AbortCode.LENGTH, 0x6000_0120),
    ],
)
def test_invalid_mapping_entry_is_refused_when_written(udp, code, word):
    variable(udp, 0x6000, "level")
    with pytest.raises(SdoAbortError) as caught:
        check_mapped(udp, word, Access.TX_MAPPABLE, 0x1A03, 4)
    assert caught.value.code == code
    assert (caught.value.index, caught.value.subindex) == (0x1A03, 4)


def test_a_received_variable_is_sent_on_but_a_sent_one_is_not_received(udp):
    variable(udp, 0x6000, "level")
    variable(udp, 0x7000, "limit")
    check_mapped(udp, 0x7000_0110, Access.TX_MAPPABLE, 0x1A00, 1)
    check_mapped(udp, 0x7000_0110, Access.RX_MAPPABLE, 0x1600, 1)
    with pytest.raises(SdoAbortError):
        check_mapped(udp, 0x6000_0110, Access.RX_MAPPABLE, 0x1600, 1)


def test_a_mapping_that_no_longer_holds_counts_what_is_left(udp: EapDictionary):
    variable(udp, 0x6000, "level")
    write(udp, 0x1A00, 1, 0x6000_0110)
    write(udp, 0x1A00, 0, 1)
    udp.remove(0x6000)
    assert mapped_bits(udp, udp[0x1A00]) == 0
    with pytest.raises(SdoAbortError) as caught:
        lay_out_mapping(udp, 0x1A00, 1, 100)
    assert caught.value.code == AbortCode.NO_OBJECT
