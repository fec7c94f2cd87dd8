"""A client that speaks AMS/TCP, written apart from our codec."""

from __future__ import annotations

import socket
import struct
from typing import Self

from tests.support import aoe


class AmsClient:
    """Speaks AMS/TCP with a station."""

    def __init__(self, address: str, sock: socket.socket | None = None) -> None:
        self.socket = sock or socket.socket()
        self.socket.settimeout(5)
        self.socket.connect((address, 48898))
        self._number = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, packet: bytes) -> None:
        self.socket.sendall(struct.pack("<HI", 0, len(packet)) + packet)

    def receive(self) -> tuple[int, bytes]:
        """Return error and data of the next packet."""
        (length,) = struct.unpack("<2xI", self._exactly(6))
        packet = self._exactly(length)
        assert struct.unpack_from("<I", packet, 28) == (self._number,)
        return int.from_bytes(packet[24:28], "little"), packet[32:]

    def ask(
        self, target: str, command: int, body: bytes, *, port: int = aoe.DEVICE
    ) -> tuple[int, bytes]:
        self._number += 1
        self.send(aoe.packet(target, command, body, port=port, invoke_id=self._number))
        return self.receive()

    def net_id(self, target: str) -> str:
        """Return the NetID that a port's own dictionary says."""
        error, data = self.ask(target, aoe.READ, aoe.read_body(0xF920 << 16 | 1))
        assert (error, data[:8]) == (0, struct.pack("<II", 0, 6))
        return ".".join(map(str, data[8:]))

    def _exactly(self, size: int) -> bytes:
        data = self.socket.recv(size, socket.MSG_WAITALL)
        assert len(data) == size
        return data
