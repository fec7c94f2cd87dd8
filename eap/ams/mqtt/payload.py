"""AMS packets as MQTT carries them: bare, or with the prefix of AMS/TCP in front.

Both are met, and nobody documents which is right.  A packet has the form that its receiver was last
heard with.  No NetID in use begins with two zeros, so the prefix is not mistaken for one.
"""

from __future__ import annotations

from typing import NamedTuple

from eap.codec.ams import AmsHeader
from eap.codec.amstcp import AmsTcpHeader, encode_with_prefix
from eap.errors import TruncatedError


class Payload(NamedTuple):
    """What a message brought."""

    packet: bytes
    is_prefixed: bool


def decode_payload(payload: bytes) -> Payload:
    """Return the packet in a message.

    Raises:
        TruncatedError: there is not even a header.
    """
    start = AmsTcpHeader.SIZE
    if len(payload) >= start + AmsHeader.SIZE:
        prefix = AmsTcpHeader.decode(payload)
        if prefix.reserved == 0 and prefix.length == len(payload) - start:
            return Payload(payload[start:], is_prefixed=True)
    if len(payload) < AmsHeader.SIZE:
        text = f"{len(payload)} octets, expected {AmsHeader.SIZE} or more"
        raise TruncatedError(text, layout="AmsHeader")
    return Payload(payload, is_prefixed=False)


def encode_payload(payload: Payload) -> bytes:
    """Return the message that carries a packet."""
    return encode_with_prefix(payload.packet) if payload.is_prefixed else payload.packet
