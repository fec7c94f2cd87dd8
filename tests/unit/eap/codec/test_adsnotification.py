from __future__ import annotations

import datetime as dt

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.adsnotification import (
    AddNotification,
    NotificationSample,
    Stamp,
    TransMode,
    decode_notification,
    encode_notification,
    to_filetime,
)
from eap.errors import CodecError, MalformedError, TruncatedError
from tests.support.wirerecords import records

U32 = st.integers(0, 0xFFFF_FFFF)
SAMPLES = st.builds(NotificationSample, U32, st.binary(max_size=20))
STAMPS = st.builds(Stamp, st.integers(0, (1 << 64) - 1), st.lists(SAMPLES, max_size=4).map(tuple))


def test_notification_packet_matches_wire_layout() -> None:
    stamps = [
        Stamp(0x01DA, (NotificationSample(1, b"ab"), NotificationSample(2, b""))),
        Stamp(0x01DB, (NotificationSample(1, b"c"),)),
    ]
    octets = bytes.fromhex(
        "37000000 02000000"
        " da01000000000000 02000000 01000000 02000000 6162 02000000 00000000"
        " db01000000000000 01000000 01000000 01000000 63"
    )
    assert encode_notification(stamps) == octets
    assert decode_notification(octets) == stamps


def test_request_of_adslib() -> None:
    octets = bytes.fromhex("40400000 10000000 04000000 03000000 20a10700 400d0300") + bytes(16)
    asked = AddNotification(0x4040, 16, 4, TransMode.SERVER_CYCLE, 500_000, 200_000)
    assert AddNotification.decode(octets) == asked
    assert asked.encode() == octets


def test_filetime_counts_from_1601() -> None:
    since = dt.datetime(2026, 1, 1, tzinfo=dt.UTC) - dt.datetime(1601, 1, 1, tzinfo=dt.UTC)
    unix = dt.datetime(2026, 1, 1, tzinfo=dt.UTC).timestamp()
    assert to_filetime(int(unix) * 10**9 + 199) == since.days * 86400 * 10**7 + 1


@given(records(AddNotification))
def test_request_round_trip(asked: AddNotification) -> None:
    assert AddNotification.decode(asked.encode()) == asked


@given(st.lists(STAMPS, max_size=4), st.data())
def test_packets_round_trip_and_truncate(stamps: list[Stamp], data: st.DataObject) -> None:
    octets = encode_notification(stamps)
    assert decode_notification(octets) == stamps
    with pytest.raises(CodecError):
        decode_notification(octets[: data.draw(st.integers(0, len(octets) - 1))])
    with pytest.raises(MalformedError, match="DeviceNotification"):
        decode_notification(octets + b".")


def test_sample_that_is_cut_off() -> None:
    octets = encode_notification([Stamp(1, (NotificationSample(1, b"abcd"),))])
    with pytest.raises(TruncatedError, match="sample of 4 bytes, but 3 follow"):
        decode_notification(octets[:-1])


@given(st.binary(max_size=60))
def test_garbage_decodes_or_raises_codec_error(noise: bytes) -> None:
    try:
        stamps = decode_notification(noise)
    except CodecError:
        return
    assert encode_notification(stamps)[4:] == noise[4:]
