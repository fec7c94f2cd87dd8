"""Whatever ``eapctl decode`` is given: no exception at all may pass."""

from __future__ import annotations

import msgspec

from eap.ops.decode import decode_frame
from eap.recording.packets import unwrap


def fuzz_one(data: bytes) -> None:
    """Decode the octets as a frame and as what an Ethernet frame carries."""
    packet = unwrap(data)
    for octets in (data, packet.payload if packet else b""):
        msgspec.json.encode(decode_frame(octets))
