"""Fragments of AMS packets from three senders: whole packets come out, and memory is bounded."""

from __future__ import annotations

import msgspec

from eap.ams.reassembly import Reassembly
from eap.codec.ams import AmsCommand, AmsHeader, decode_packet
from eap.errors import CodecError
from eap.ids import Endpoint, NetId
from tools.fuzz.messages import cut

_WAYS = tuple(Endpoint("fuzz", str(number)) for number in range(3))
_HEAD = AmsHeader(NetId(b"target"), 1, NetId(b"source"), 2, AmsCommand.FRAGMENT)


def fuzz_one(data: bytes) -> None:
    """Give each message of *data* as the body of a fragment, which its first octet numbers."""
    parts, given = Reassembly(), 0
    for message in cut(data):
        number = message[0] if message else 0
        header = msgspec.structs.replace(_HEAD, invoke_id=(number >> 6) << 16 | number & 3)
        given += len(message)
        try:
            packet = parts.receive(_WAYS[number >> 4 & 1], header, message[1:], given).packet
            if packet is not None and len(packet) - AmsHeader.SIZE != len(decode_packet(packet)[1]):
                raise AssertionError("the packet has another length than its header says")
        except CodecError:
            pass
        if not 0 <= parts.octets <= given:
            raise AssertionError(f"{parts.octets} octets are kept of {given}")
