"""Datagrams of UDP port 48899."""

from __future__ import annotations

from eap.codec.amsdiscovery import decode_discovery, decode_text, encode_discovery, encode_text
from eap.errors import CodecError


def fuzz_one(data: bytes) -> None:
    """Read a datagram and write it again; only CodecError may pass."""
    try:
        read = decode_discovery(data)
    except CodecError:
        return
    if not data.startswith(encode_discovery(read.header, read.tags)):
        raise AssertionError("the datagram encodes to other octets")
    for _, content in read.tags:
        text = decode_text(content)
        if decode_text(encode_text(text)) != text:
            raise AssertionError(f"{text!r} is read as another text")
