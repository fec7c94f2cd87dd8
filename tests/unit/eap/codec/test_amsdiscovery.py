from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.amsdiscovery import (
    COOKIE,
    Discovery,
    DiscoveryHeader,
    DiscoveryService,
    Tag,
    decode_discovery,
    decode_text,
    decode_version,
    encode_discovery,
    encode_text,
    encode_version,
)
from eap.errors import CodecError, MalformedError, TruncatedError
from eap.ids import NetId
from tests.support.wirerecords import records

headers = records(DiscoveryHeader)
tag_lists = st.lists(st.tuples(st.integers(0, 0xFFFF), st.binary(max_size=20)), max_size=5)
HEADER = DiscoveryHeader(
    0, 7, DiscoveryService.SERVER_INFO, NetId.parse("1.2.3.4.5.6"), 10000, count=99
)


def test_datagram_matches_wire_layout() -> None:
    octets = encode_discovery(HEADER, [(Tag.HOST, encode_text("pc")), (Tag.RESULT, bytes(4))])
    assert octets.hex() == (
        "03661471" + "07000000" + "01000000" + "010203040506" + "1027" + "02000000"
        "0500" + "0300" + "706300" + "0100" + "0400" + "00000000"
    )  # fmt: skip
    assert DiscoveryHeader.SIZE == 24


@given(headers, tag_lists, st.binary(max_size=9))
def test_discovery_datagram_survives_its_bytes(
    header: DiscoveryHeader, tags: list, surplus: bytes
) -> None:
    octets = encode_discovery(header, tags)
    read = decode_discovery(octets + surplus)
    assert list(read.tags) == tags
    assert (read.header.cookie, read.header.count) == (COOKIE, len(tags))
    assert encode_discovery(read.header, read.tags) == octets


@given(headers, tag_lists, st.data())
def test_every_prefix_is_truncated(
    header: DiscoveryHeader, tags: list, data: st.DataObject
) -> None:
    octets = encode_discovery(header, tags)
    with pytest.raises(TruncatedError):
        decode_discovery(octets[: data.draw(st.integers(0, len(octets) - 1))])


@given(st.binary(max_size=60), st.booleans())
def test_garbage_decodes_or_raises_codec_error(noise: bytes, with_cookie: bool) -> None:
    octets = COOKIE.to_bytes(4, "little") + noise if with_cookie else noise
    try:
        read = decode_discovery(octets)
    except CodecError:
        return
    assert octets.startswith(encode_discovery(read.header, read.tags))


def test_count_of_tags_that_are_not_there_ends_early() -> None:
    octets = bytearray(encode_discovery(HEADER, [(1, b"x")]))
    octets[20:24] = b"\xff\xff\xff\xff"
    with pytest.raises(TruncatedError, match="TagHeader"):
        decode_discovery(octets)


def test_another_cookie_is_refused() -> None:
    octets = bytearray(encode_discovery(HEADER))
    octets[0] = 4
    with pytest.raises(MalformedError, match="cookie is 0x71146604, expected 0x71146603"):
        decode_discovery(octets)


def test_the_first_of_equal_tags_is_found() -> None:
    message = Discovery(HEADER, ((5, b"a\0"), (2, b""), (5, b"b\0")))
    assert message.find(Tag.HOST) == b"a\0"
    assert message.find(Tag.PASSWORD) == b""
    assert message.find(Tag.USER) is None


def test_texts() -> None:
    assert encode_text("Büro") == b"B\xc3\xbcro\0"
    assert [decode_text(data) for data in (b"pc\0", b"pc", b"", b"p\0c\0", b"\xff\0")] == [
        "pc", "pc", "", "p", "\ufffd",
    ]  # fmt: skip
    with pytest.raises(CodecError, match="a NUL in"):
        encode_text("p\0c")


def test_too_long_a_tag_is_refused() -> None:
    with pytest.raises(CodecError):
        encode_discovery(HEADER, [(1, bytes(0x10000))])


@pytest.mark.parametrize(
    ("text", "octets", "read"),
    [
        ("3.1.4024", b"\3\1\xb8\x0f", "3.1.4024"),
        ("0.2", b"\0\2\0\0", "0.2.0"),
        ("1.2.3.dev4", b"\1\2\3\0", "1.2.3"),
        ("1.x.700000", b"\1\0\xff\xff", "1.0.65535"),
        ("2026.1", b"\xff\1\0\0", "255.1.0"),
        ("", b"\0\0\0\0", "0.0.0"),
    ],
)
def test_versions(text, octets, read) -> None:
    assert encode_version(text) == octets
    assert decode_version(octets) == read


def test_a_version_of_another_length_is_none() -> None:
    assert decode_version(b"\1\2\3") == ""
