from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.pd import (
    CYCLE_OFFSET,
    FIRST_PD,
    PdFrameHeader,
    PdHeader,
    decode_frame_header,
    encode_frame,
    iter_pds,
)
from eap.errors import CodecError, MalformedError, TruncatedError
from eap.ids import NetId

PUBLISHER = NetId.parse("192.168.0.1.1.1")
words = st.integers(0, 0xFFFF)
pds = st.lists(st.tuples(words, words, words, st.binary(max_size=40)), max_size=12)


def build(items: list[tuple[int, int, int, bytes]], cycle: int = 7) -> bytes:
    return encode_frame(
        PdFrameHeader(PUBLISHER, 0, cycle),
        [(PdHeader(pd_id, version, 0, quality), data) for pd_id, version, quality, data in items],
    )


@given(pds, words)
def test_pd_frame_survives_its_bytes(items: list[tuple[int, int, int, bytes]], cycle: int) -> None:
    frame = build(items, cycle)
    assert decode_frame_header(frame) == PdFrameHeader(PUBLISHER, len(items), cycle)
    read = [(pd.pd_id, pd.version, pd.quality, bytes(data)) for pd, data in iter_pds(frame)]
    assert read == items


@given(pds.filter(bool), st.data())
def test_every_prefix_is_truncated(
    items: list[tuple[int, int, int, bytes]], data: st.DataObject
) -> None:
    frame = build(items)
    cut = data.draw(st.integers(0, len(frame) - 1))
    with pytest.raises(TruncatedError):
        list(iter_pds(frame[:cut]))


@given(st.binary(max_size=80), st.booleans())
def test_garbage_decodes_or_raises_codec_error(noise: bytes, as_type_4: bool) -> None:
    if as_type_4:
        noise = EtherCatHeader(len(noise)).encode() + noise
    try:
        total = sum(len(data) + PdHeader.SIZE for _, data in iter_pds(noise))
    except CodecError:
        return
    assert FIRST_PD + total <= len(noise)


def test_padding_and_surplus_octets_are_ignored() -> None:
    frame = bytearray(build([(1, 2, 3, b"ab")]) + b"\xee" * 3)
    frame[0] += 2
    assert [bytes(data) for _, data in iter_pds(frame)] == [b"ab"]


def test_reserved_and_state_octets_never_refuse_a_frame() -> None:
    frame = bytearray(build([]))
    frame[CYCLE_OFFSET + 2 : CYCLE_OFFSET + 4] = b"\xff\x28"
    header = decode_frame_header(frame)
    assert (header.cycle, header.reserved, header.eap_sm) == (7, 0xFF, 0x28)


def test_views_are_not_copies() -> None:
    frame = bytearray(build([(1, 2, 3, b"ab")]))
    ((_, data),) = iter_pds(frame)
    frame[-1] = ord("z")
    assert bytes(data) == b"az"


def test_other_type_is_malformed() -> None:
    with pytest.raises(MalformedError, match="frame type 5, expected 4"):
        decode_frame_header(EtherCatHeader(12, type=FrameType.MAILBOX).encode() + bytes(12))


def test_count_that_cannot_fit_is_truncated_before_any_pd() -> None:
    frame = bytearray(build([(1, 0, 0, b"abcdefgh")]))
    frame[8:10] = b"\xff\xff"
    with pytest.raises(TruncatedError, match="65535 PDs need at least"):
        next(iter_pds(frame))


def test_pd_that_reaches_past_the_frame_is_truncated_after_the_good_ones() -> None:
    frame = bytearray(build([(1, 0, 0, b"ab"), (2, 0, 0, b"cd")]))
    frame[FIRST_PD + 10 + 4] = 3
    pds_read = iter_pds(frame)
    assert next(pds_read)[0].pd_id == 1
    with pytest.raises(TruncatedError, match="PD 2 has 2 of 3 bytes"):
        next(pds_read)
