"""Ethernet frames around EtherCAT frames, as they come in captures."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterable, Iterator, Sequence

import dpkt

SOURCE_MAC = bytes.fromhex("020105000001")
MULTICAST_MAC = bytes.fromhex("010105040000")
SERVER, CLIENT = "127.0.1.1", "127.0.1.2"
PORT, CLIENT_PORT = 34980, 40000


def ethernet(frame: bytes, *, vlan: int | None = None, ethertype: int = 0x88A4) -> bytes:
    """*frame* under our EtherType, padded, tagged with the TCI *vlan* if there is one."""
    tag = b"" if vlan is None else struct.pack(">HH", 0x8100, vlan)
    return (MULTICAST_MAC + SOURCE_MAC + tag + struct.pack(">H", ethertype) + frame).ljust(
        60, b"\0"
    )


def udp(frame: bytes, *, source_port: int = PORT, port: int = PORT) -> bytes:
    """*frame* in a UDP datagram."""
    datagram = dpkt.udp.UDP(sport=source_port, dport=port, data=frame, ulen=8 + len(frame))
    return _ip(datagram, dpkt.ip.IP_PROTO_UDP, CLIENT, SERVER)


def tcp_segment(payload: bytes, sequence: int, *, flags: int = 0x18, reply: bool = False) -> bytes:
    """One segment of the connection from CLIENT to our port, or back."""
    ports = (PORT, CLIENT_PORT) if reply else (CLIENT_PORT, PORT)
    segment = dpkt.tcp.TCP(
        sport=ports[0], dport=ports[1], seq=sequence % 2**32, flags=flags, data=payload
    )
    ends = (SERVER, CLIENT) if reply else (CLIENT, SERVER)
    return _ip(segment, dpkt.ip.IP_PROTO_TCP, *ends)


def tcp_stream(
    frames: Iterable[bytes], *, cuts: Sequence[int] = (), start: int = 1000
) -> Iterator[bytes]:
    """The frames in one connection, its opening included, cut into segments at *cuts*."""
    stream = b"".join(frames)
    yield tcp_segment(b"", start, flags=0x02)
    yield tcp_segment(b"", 5000, flags=0x12, reply=True)
    yield tcp_segment(b"", start + 1, flags=0x10)
    edges = [0, *sorted({cut for cut in cuts if 0 < cut < len(stream)}), len(stream)]
    for begin, end in itertools.pairwise(edges):
        yield tcp_segment(stream[begin:end], start + 1 + begin)


def _ip(body: dpkt.Packet, protocol: int, source: str, destination: str) -> bytes:
    packet = dpkt.ip.IP(
        p=protocol,
        src=bytes(map(int, source.split("."))),
        dst=bytes(map(int, destination.split("."))),
        data=body,
    )
    packet.len = len(packet)
    return bytes(dpkt.ethernet.Ethernet(dst=MULTICAST_MAC, src=SOURCE_MAC, data=packet))
