"""The network side of a simulated device with EoE: it answers ARP (RFC 826) and ping (RFC 792).

Enough for somebody to see that frames get to the device and back, in fragments where they are long.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import NamedTuple

from eap.codec.eoe import IpSettings

DEFAULT_MAC = bytes.fromhex("020e5a000001")
_BROADCAST = b"\xff" * 6
_IP, _ARP = 0x0800, 0x0806
_ETHERNET = 14
_ARP_REQUEST = bytes.fromhex("0001 0800 06 04 0001")
_ARP_REPLY = bytes.fromhex("0001 0800 06 04 0002")
_ARP_SIZE = 28
_ICMP = 1
_ECHO_REQUEST, _ECHO_REPLY = 8, 0
_IP_HEADER = 20
_FRAGMENT = 0x3FFF


class _Addresses(NamedTuple):
    mac: bytes
    ip: bytes


class EthernetHost:
    """One host behind a slave's mailbox.

    Args:
        settings: Returns its IP settings; without an address it answers nothing.
    """

    def __init__(self, settings: Callable[[], IpSettings]) -> None:
        self._settings = settings

    def receive_frame(self, frame: bytes) -> list[bytes]:
        """Return the answers to an Ethernet frame without check sequence."""
        settings = self._settings()
        if settings.ip is None or len(frame) < _ETHERNET:
            return []
        own = _Addresses(bytes(settings.mac or DEFAULT_MAC), settings.ip.packed)
        if frame[:6] not in {own.mac, _BROADCAST}:
            return []
        (kind,) = struct.unpack_from(">H", frame, 12)
        answer = None
        if kind == _ARP:
            answer = _answer_arp(frame, own)
        elif kind == _IP:
            answer = _answer_ping(frame, own)
        return [] if answer is None else [answer]


def _answer_arp(frame: bytes, own: _Addresses) -> bytes | None:
    body = frame[_ETHERNET : _ETHERNET + _ARP_SIZE]
    if len(body) < _ARP_SIZE or body[:8] != _ARP_REQUEST or body[24:28] != own.ip:
        return None
    asker = body[8:18]
    reply = _ARP_REPLY + own.mac + own.ip + asker
    return asker[:6] + own.mac + _ARP.to_bytes(2, "big") + reply


def _answer_ping(frame: bytes, own: _Addresses) -> bytes | None:
    packet = frame[_ETHERNET:]
    if len(packet) < _IP_HEADER or packet[0] >> 4 != 4:
        return None
    header_size = 4 * (packet[0] & 0x0F)
    total, fragment = struct.unpack_from(">2xH2xH", packet)
    message = packet[header_size:total]
    is_whole = header_size >= _IP_HEADER and len(message) == total - header_size >= 8
    if not is_whole or fragment & _FRAGMENT or packet[9] != _ICMP or packet[16:20] != own.ip:
        return None
    if message[0] != _ECHO_REQUEST:
        return None
    header = packet[:12] + packet[16:20] + packet[12:16] + packet[20:header_size]
    reply = bytearray(message)
    reply[0] = _ECHO_REPLY
    reply[2:4] = bytes(2)
    reply[2:4] = _checksum(reply).to_bytes(2, "big")
    return frame[6:12] + own.mac + frame[12:14] + header + reply


def _checksum(octets: bytes | bytearray) -> int:
    """Return the Internet check sum (RFC 1071)."""
    padded = bytes(octets) + bytes(len(octets) % 2)
    total: int = sum(struct.unpack(f">{len(padded) // 2}H", padded))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF
