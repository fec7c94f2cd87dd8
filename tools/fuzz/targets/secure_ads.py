"""Secure ADS: its message, certificates in handshakes, and AMS packets without a prefix."""

from __future__ import annotations

from eap.ams.reassembly import BareAmsDecoder, OversizedPacket
from eap.codec.ams import AmsHeader
from eap.codec.secureads import decode_connect_info, length_of
from eap.codec.tlshandshake import find_certificate, is_self_issued
from eap.errors import CodecError, MalformedError

LIMIT = 96


def fuzz_one(data: bytes) -> None:
    """Read *data* as each of them; only CodecError may pass."""
    try:
        length = length_of(data)
        info = decode_connect_info(data)
    except CodecError:
        pass
    else:
        if length is None or length > len(data):
            raise AssertionError(f"a message of {length} octets in {len(data)}")
        if (
            bool(info.user) == bool(info.password)
            and len(info.user + info.password) < LIMIT
            and decode_connect_info(info.encode()) != info
        ):
            raise AssertionError("the message is read as another one")
    found = find_certificate(data)
    if found is not None and found not in data and len(data) < AmsHeader.SIZE:
        raise AssertionError("a certificate that nobody sent")
    is_self_issued(data)
    _cut(data)


def _cut(data: bytes) -> None:
    """Read packets in pieces, each as long as its first octet says."""
    cutter, at, found = BareAmsDecoder(LIMIT), 0, 0
    while at < len(data):
        end = at + 1 + data[at] % 80
        packet = cutter.receive_one(data[at:end])
        found += len(packet or b"")
        at = end
        try:
            while (piece := cutter.next_item()) is not None:
                if isinstance(piece, OversizedPacket):
                    if piece.length <= LIMIT:
                        raise AssertionError("a packet within the limit is too long")
                elif isinstance(piece, bytes):
                    found += len(piece)
        except MalformedError:
            break
    if found > len(data):
        raise AssertionError(f"{found} octets came out of {len(data)}")
