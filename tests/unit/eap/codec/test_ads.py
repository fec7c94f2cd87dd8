"""Records of ADS services."""

from __future__ import annotations

import pytest

from eap.codec.ads import AdsError, AdsRange, AdsReadWrite, IndexGroup, encode_result
from eap.errors import TruncatedError


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
