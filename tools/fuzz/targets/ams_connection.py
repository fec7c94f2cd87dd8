"""A whole AMS/TCP connection: each request is handed on once, and never too many at a time."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Any

from eap.codec.ams import AmsAnswer, AmsHeader, AmsTcpHeader, encode_with_prefix, response_to
from eap.runtime.drop_counters import DropReason
from eap.services.transports.ams_connection import MAX_REQUESTS, AmsConnection


def fuzz_one(data: bytes) -> None:
    """Feed *data* in pieces, each as long as its first octet says, most of them with a prefix.

    Answers come late or at once, as an octet says; the peer takes them or does not, likewise.
    """
    asyncio.run(_feed(data))


class _Transport(asyncio.Transport):
    def __init__(self) -> None:
        super().__init__()
        self.is_paused = False
        self.is_closed = False
        self.packets = 0

    def write(self, data: Any) -> None:
        self.packets += 1

    def pause_reading(self) -> None:
        if self.is_paused:
            raise AssertionError("paused twice")
        self.is_paused = True

    def resume_reading(self) -> None:
        if not self.is_paused:
            raise AssertionError("not paused")
        self.is_paused = False

    def is_closing(self) -> bool:
        return self.is_closed

    def close(self) -> None:
        self.is_closed = True

    def abort(self) -> None:
        self.is_closed = True

    def get_write_buffer_size(self) -> int:
        return 0


class _Receiver:
    def __init__(self) -> None:
        self.connection: AmsConnection
        self.waiting: deque[bytes] = deque()
        self.refused = 0
        self.is_slow = False

    def connection_opened(self, connection: AmsConnection) -> None:
        self.connection = connection

    def handle_packet(self, packet: bytes, connection: AmsConnection) -> None:
        header = AmsHeader.decode(packet)
        if header.state_flags & 2 or header.command in {8, 0x0902}:
            return
        self.waiting.append(response_to(header, AmsAnswer(b"1234")))
        if len(self.waiting) > MAX_REQUESTS:
            raise AssertionError("too many requests are under way")
        if not self.is_slow:
            self.answer()

    def handle_answer(self, packet: bytes, connection: AmsConnection) -> None:
        if not packet[18] & 1:
            raise AssertionError("a request is taken for an answer")

    def connection_closed(self, connection: AmsConnection, why: str) -> None:
        pass

    def count_dropped(self, reason: DropReason) -> None:
        self.refused += 1

    def answer(self) -> None:
        if self.waiting:
            self.connection.send([self.waiting.popleft()])


def _octets(piece: bytes, first: int) -> bytes:
    """Return *piece* as it is, behind a prefix, or as packets with the right length."""
    if first > 0xF0:
        return piece
    if first & 8:
        body = piece[AmsHeader.SIZE :]
        head = piece[: AmsHeader.SIZE].ljust(AmsHeader.SIZE, b"\4")
        piece = head[:20] + len(body).to_bytes(4, "little") + head[24:] + body
    return encode_with_prefix(piece) * (1 + first % 3)


async def _feed(data: bytes) -> None:
    handler, transport = _Receiver(), _Transport()
    connection = AmsConnection("fuzz", "10.0.0.1", handler)
    connection.connection_made(transport)
    at, fed, is_blocked = 0, 0, False
    while at < len(data) and not transport.is_closed:
        first = data[at]
        end = at + 1 + first % 80
        octets = _octets(data[at:end], first)
        handler.is_slow = bool(first & 1)
        if bool(first & 2) is not is_blocked:
            is_blocked = not is_blocked
            connection.pause_writing() if is_blocked else connection.resume_writing()
        if not transport.is_paused:
            connection.get_buffer(-1)[: len(octets)] = octets
            connection.buffer_updated(len(octets))
            at, fed = end, fed + len(octets)
        else:
            handler.answer()
            if is_blocked and first & 4:
                is_blocked = False
                connection.resume_writing()
            at += 1
        await asyncio.sleep(0)
    if is_blocked and connection.late_since_ns is None:
        raise AssertionError("a peer that takes no answers is not late")
    if not transport.is_paused and not transport.is_closed:
        connection.eof_received()
    connection.connection_lost(None)
    if transport.packets > fed // (AmsTcpHeader.SIZE + AmsHeader.SIZE):
        raise AssertionError("more answers than requests can have been")
