"""A TCP connection of AMS packets, cut anywhere: no octet invented, and memory stays bounded."""

from __future__ import annotations

from eap.ams.reassembly import AmsStreamDecoder, OversizedPacket
from eap.codec.ams import encode_with_prefix
from eap.errors import MalformedError

LIMIT = 64


def fuzz_one(data: bytes) -> None:
    """Read *data* in pieces, each as long as its first octet says, some with a prefix."""
    cutter, at, fed, found = AmsStreamDecoder(LIMIT), 0, 0, 0
    while at < len(data):
        end = at + 1 + data[at] % 80
        octets = data[at:end] if data[at] > 0xE0 else encode_with_prefix(data[at:end])
        cutter.receive(octets)
        at, fed = end, fed + len(octets)
        try:
            while (piece := cutter.next_item()) is not None:
                if isinstance(piece, OversizedPacket) and piece.length <= LIMIT:
                    raise AssertionError("a packet within the limit is too long")
                found += len(piece) if isinstance(piece, bytes) else 0
        except MalformedError:
            break
    if found > fed:
        raise AssertionError(f"{found} octets came out of {fed}")
