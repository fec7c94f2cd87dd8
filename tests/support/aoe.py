"""A client that speaks ADS in frames of type 5, written apart from our codec.

Octets are put together by ``struct`` from the public layouts: an EtherCAT header of 2 octets, a
mailbox header of 6, an AMS header of 32.
"""

from __future__ import annotations

import socket
import struct
from typing import NamedTuple, Self

DEVICE = 0xFFFF
READ, WRITE, READ_STATE = 2, 3, 4
SDO = 0xF302
_AMS = struct.Struct("<6sH6sHHHIII")
CLIENT = "192.168.9.9.1.1"


class Answer(NamedTuple):
    """Reply to a request."""

    error: int
    """Of the AMS header."""
    result: int | None
    data: bytes
    invoke_id: int


def net_id(text: str) -> bytes:
    return bytes(int(part) for part in text.split("."))


def packet(
    target: str,
    command: int,
    body: bytes,
    *,
    port: int = DEVICE,
    invoke_id: int = 1,
    flags: int = 4,
) -> bytes:
    """Return an AMS packet."""
    source = net_id(CLIENT), 33000
    head = _AMS.pack(net_id(target), port, *source, command, flags, len(body), 0, invoke_id)
    return head + body


def frame(data: bytes, *, kind: int = 1, address: int = 0, counter: int = 1) -> bytes:
    """Return a frame of type 5 around the data of a mailbox message."""
    mailbox = struct.pack("<HHBB", len(data), address, 0, kind | counter << 4) + data
    return struct.pack("<H", len(mailbox) | 5 << 12) + mailbox


def read_body(offset: int, size: int = 4096, group: int = SDO) -> bytes:
    return struct.pack("<III", group, offset, size)


def write_body(offset: int, data: bytes, group: int = SDO) -> bytes:
    return struct.pack("<III", group, offset, len(data)) + data


def opened(data: bytes) -> bytes:
    """Return the AMS packet in a frame of type 5, checking both headers around it."""
    (word,) = struct.unpack_from("<H", data)
    assert word >> 12 == 5
    length, address, priority, kind = struct.unpack_from("<HHBB", data, 2)
    assert (address, priority, kind & 0x0F) == (0, 0, 1)
    assert 1 <= kind >> 4 <= 7
    assert word & 0x7FF == length + 6 <= len(data) - 2
    return data[8 : 8 + length]


def answer(data: bytes) -> Answer:
    """Read a frame with a response."""
    ams = opened(data)
    *_, command, flags, length, error, invoke_id = _AMS.unpack_from(ams)
    assert flags & 1
    body = ams[_AMS.size :]
    assert len(body) == length
    if error or len(body) < 4:
        return Answer(error, None, body, invoke_id)
    result, rest = int.from_bytes(body[:4], "little"), body[4:]
    if command == READ:
        assert len(rest) == 4 + int.from_bytes(rest[:4], "little")
        rest = rest[4:]
    return Answer(error, result, rest, invoke_id)


class UdpClient:
    """Asks a device by UDP, one question at a time."""

    def __init__(self, host: str, target: str, *, port: int = 34980, source: str = "") -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((source or host, 0))
        self.socket.settimeout(5)
        self.peer = host, port
        self.target = target
        self._number = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def ask(self, command: int, body: bytes, **more: int) -> Answer:
        self._number += 1
        sent = frame(packet(self.target, command, body, invoke_id=self._number, **more))
        self.socket.sendto(sent, self.peer)
        data, sender = self.socket.recvfrom(2048)
        assert sender == self.peer
        got = answer(data)
        assert got.invoke_id == self._number
        return got

    def read(self, index: int, subindex: int = 0, *, complete: bool = False) -> Answer:
        return self.ask(READ, read_body(index << 16 | complete << 8 | subindex))

    def write(self, index: int, subindex: int, data: bytes, *, complete: bool = False) -> Answer:
        return self.ask(WRITE, write_body(index << 16 | complete << 8 | subindex, data))
