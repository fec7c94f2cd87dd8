"""AMS packets."""

from __future__ import annotations

from eap.codec.ams import decode_packet, encode_packet
from eap.errors import CodecError


def fuzz_one(data: bytes) -> None:
    """Read a packet and write it again; only CodecError may pass."""
    try:
        header, body = decode_packet(data)
    except CodecError:
        return
    if not data.startswith(encode_packet(header, body)):
        raise AssertionError("the packet encodes to other octets")
