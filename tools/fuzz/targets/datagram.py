"""Frames of type 1."""

from __future__ import annotations

from devicebus.wire.datagram import encode_frame, iter_datagrams
from eap.errors import CodecError


def fuzz_one(data: bytes) -> None:
    """Read every datagram and write the frame again; only CodecError may pass."""
    try:
        datagrams = list(iter_datagrams(data))
    except CodecError:
        return
    again = encode_frame(datagrams)
    if again[2:] != data[2 : len(again)]:
        raise AssertionError("the datagrams encode to other octets")
