"""Segments of a TCP connection in any order: no exception, and not one octet invented."""

from __future__ import annotations

from eap.recording.packets import Stream, TcpSegment


def fuzz_one(data: bytes) -> None:
    """Read *data* as segments: a sequence number, flags, a length and as many octets."""
    stream, fed, found, at = Stream(), 0, 0, 0
    while at + 6 <= len(data):
        segment = TcpSegment(int.from_bytes(data[at : at + 4], "little"), data[at + 4] > 0xF0)
        payload = data[at + 6 : at + 6 + data[at + 5] % 64]
        at, fed = at + 6 + len(payload), fed + len(payload)
        found += sum(map(len, stream.receive(segment, payload)))
    found += sum(map(len, stream.flush()))
    if found > fed:
        raise AssertionError(f"{found} octets came out of {fed}")
