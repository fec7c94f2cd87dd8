from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.ams import (
    AmsTcpHeader,
    decode_prefix,
    encode_net_id,
    encode_opened_port,
    encode_with_prefix,
)
from eap.errors import MalformedError, TruncatedError
from eap.ids import NetId


@given(st.binary(min_size=32, max_size=200), st.binary(max_size=5))
def test_prefix_round_trip(packet: bytes, before: bytes) -> None:
    octets = encode_with_prefix(packet)
    assert octets == b"\0\0" + len(packet).to_bytes(4, "little") + packet
    assert decode_prefix(before + octets, len(before)) == len(packet)


@given(st.integers(0, 5))
def test_every_prefix_of_it_is_truncated(size: int) -> None:
    with pytest.raises(TruncatedError, match="AmsTcpHeader"):
        decode_prefix(AmsTcpHeader(0, 32).encode()[:size])


@pytest.mark.parametrize(
    ("header", "text"),
    [
        (AmsTcpHeader(0x1000, 40), "reserved is 0x1000, expected 0"),
        (AmsTcpHeader(0, 31), "length 31, expected 32 or more"),
        (AmsTcpHeader(0, 0), "length 0, expected 32 or more"),
    ],
)
def test_what_is_no_packet_is_refused(header: AmsTcpHeader, text: str) -> None:
    with pytest.raises(MalformedError, match=text):
        decode_prefix(header.encode())


def test_address_of_a_local_client() -> None:
    """As the open client ads-client takes it: command, length, NetID, port."""
    net_id = NetId.parse("1.2.3.4.5.6")
    assert encode_opened_port(net_id, 0x8001) == bytes.fromhex("0010 08000000 010203040506 0180")
    assert encode_net_id(net_id) == bytes.fromhex("0210 06000000 010203040506")
