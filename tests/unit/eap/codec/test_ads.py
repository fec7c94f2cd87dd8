"""Records of ADS services."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.ads import (
    AdsDeviceInfo,
    AdsError,
    AdsRange,
    AdsReadWrite,
    AdsStates,
    AdsSystemState,
    AdsWriteControl,
    IndexGroup,
    SdoOffset,
    SoeOffset,
    device_name,
    encode_result,
)
from eap.errors import TruncatedError
from tests.support.wirerecords import records

RECORDS = (AdsRange, AdsReadWrite, AdsDeviceInfo, AdsStates, AdsWriteControl, AdsSystemState,
           SdoOffset, SoeOffset)  # fmt: skip


def test_read_request_of_the_vector() -> None:
    octets = bytes.fromhex("02f300000100181004000000")
    asked = AdsRange.decode(octets)
    assert asked == AdsRange(IndexGroup.SDO, 0x1018_0001, 4)
    assert asked.encode() == octets
    with pytest.raises(TruncatedError):
        AdsRange.decode(octets[:-1])


def test_read_write_has_two_lengths() -> None:
    both = AdsReadWrite(IndexGroup.SDO, 0, read_length=5, write_length=6)
    assert both.encode()[8:] == bytes.fromhex("05000000 06000000")


def test_results() -> None:
    assert encode_result(AdsError.SIZE) == bytes.fromhex("05070000")
    assert encode_result(AdsError.NONE, b"ab") == bytes.fromhex("00000000 02000000") + b"ab"


def test_device_info_has_a_name_of_16_octets() -> None:
    info = AdsDeviceInfo(3, 1, 4024, device_name("a name that is too long"))
    assert info.encode() == bytes.fromhex("0301b80f") + b"a name that is \0"
    assert AdsDeviceInfo.decode(info.encode()) == info
    assert device_name("Größe €") == "Größe ?".encode("latin-1").ljust(16, b"\0")


def test_system_state_has_16_octets() -> None:
    state = AdsSystemState(5, 1, restart_index=7, version=3, revision=1, build=4024)
    assert state.encode() == bytes.fromhex("0500 0100 0700 0301 b80f 0000 0000 0000")


def test_offsets_of_objects_and_idns() -> None:
    place = SdoOffset(subindex=3, is_complete=1, is_slow=1, index=0x1018)
    assert int.from_bytes(place.encode(), "little") == 0x1018_0303
    place = SoeOffset(idn=0x8032, elements=0x41, drive=7, is_command=1)
    assert int.from_bytes(place.encode(), "little") == 0x0F41_8032


def test_codes_have_names() -> None:
    assert AdsError.name_of(0x710) == "SYMBOL_NOT_FOUND"
    assert AdsError.name_of(0x7FF) == "0x7ff"


def test_codes_have_words() -> None:
    assert AdsError.words_of(0x1B) == "error 0x1b (host unreachable)"
    assert AdsError.words_of(0x710) == "error 0x710 (SYMBOL_NOT_FOUND)"
    assert AdsError.words_of(0) == "no error"


@given(st.data())
def test_records_round_trip_and_truncate(data: st.DataObject) -> None:
    record = data.draw(st.sampled_from(RECORDS))
    value = data.draw(records(record))
    octets = value.encode()
    assert record.decode(b"." + octets + b"rest", 1) == value
    cut = data.draw(st.integers(0, len(octets) - 1))
    with pytest.raises(TruncatedError, match=record.__name__):
        record.decode(octets[:cut])
