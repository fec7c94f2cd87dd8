"""Capture files: every EtherCAT frame in a pcap or pcapng file, with its time and addresses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from eap.appliance.commands.packets import Packet, Stream, unwrap
from eap.errors import MalformedError

_ETHERNET = 1
"""Link type of Ethernet in both file formats."""


class CapturedFrame(NamedTuple):
    """One frame; the packet is the one that completed it, counted from 1 as Wireshark does."""

    number: int
    at_ns: int
    """Capture time since 1970; some files hold no more than microseconds."""
    packet: Packet
    data: bytes
    """The frame from its EtherCAT header on, padding included."""


def iter_capture(path: Path) -> Iterator[CapturedFrame]:
    """Yield the frames in *path*: under our EtherType, UDP port or TCP port, in either direction.

    Frames that a TCP stream left unfinished come last.

    Raises:
        OSError: the file cannot be read.
        MalformedError: it is no capture of Ethernet, or it is damaged.
    """
    streams: dict[tuple[str, str], Stream] = {}
    last: dict[tuple[str, str], tuple[int, int, Packet]] = {}
    with path.open("rb") as file:
        for number, (at_ns, octets) in enumerate(_iter_packets(file, str(path)), 1):
            packet = unwrap(octets)
            if packet is None:
                continue
            if packet.segment is None:
                yield CapturedFrame(number, at_ns, packet, packet.payload)
                continue
            ends = (packet.source, packet.destination)
            last[ends] = (number, at_ns, packet)
            stream = streams.setdefault(ends, Stream())
            for data in stream.receive(packet.segment, packet.payload):
                yield CapturedFrame(number, at_ns, packet, data)
    for ends, stream in streams.items():
        for data in stream.flush():
            yield CapturedFrame(*last[ends], data)


def _iter_packets(file: BinaryIO, name: str) -> Iterator[tuple[int, bytes]]:
    import dpkt

    link_type = _ETHERNET
    try:
        reader = dpkt.pcap.UniversalReader(file)
        link_type = reader.datalink()
        if link_type == _ETHERNET:
            for seconds, octets in reader:
                yield round(seconds * 1_000_000_000), octets
    except (dpkt.Error, ValueError, ArithmeticError) as exc:
        raise MalformedError(
            f"no whole pcap or pcapng file ({exc})", layout=name, offset=file.tell()
        ) from None
    if link_type != _ETHERNET:
        raise MalformedError(
            f"link type {link_type}, expected {_ETHERNET}, Ethernet (capture on one interface)",
            layout=name,
        )
