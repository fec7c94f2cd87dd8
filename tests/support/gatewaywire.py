"""A mailbox gateway as seen by sockets alone: frames out, frames in, nothing understood."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

PORT = 34980
ERR, AOE, EOE, COE, FOE, SOE, VOE = 0, 1, 2, 3, 4, 5, 15
VENDOR = bytes.fromhex("0020 40 1810 01 00000000")
"""An upload of 0x1018:01."""
_LARGEST = 4096
_SETTLED_S = 0.25


class Wire(NamedTuple):
    """One client's way to a gateway."""

    sock: socket.socket
    is_stream: bool

    def send(self, frame: bytes) -> None:
        """Send a frame."""
        self.sock.sendall(frame)

    def receive(self, timeout_s: float = 2.0) -> bytes:
        """Return the next frame; raises TimeoutError."""
        self.sock.settimeout(timeout_s)
        if not self.is_stream:
            return self.sock.recv(_LARGEST)
        head = self._exactly(2)
        return head + self._exactly(struct.unpack("<H", head)[0] & 0x7FF)

    def ask(self, octets: bytes | str) -> bytes:
        """Return the answer to a frame."""
        self.send(bytes.fromhex(octets) if isinstance(octets, str) else octets)
        return self.receive()

    def is_silent(self, octets: bytes | str) -> bool:
        """Say whether nothing comes back."""
        self.send(bytes.fromhex(octets) if isinstance(octets, str) else octets)
        return not self.rest()

    def rest(self) -> list[bytes]:
        """Return all frames until it is quiet."""
        found = []
        try:
            while True:
                found.append(self.receive(_SETTLED_S))
        except TimeoutError:
            return found

    def talk(self, kind: int, address: int, body: bytes, counter: int = 2) -> tuple[int, bytes]:
        """Return type and data of the answer to a message; it has our address."""
        answer = self.ask(frame(kind, address, body, counter))
        assert int.from_bytes(answer[4:6], "little") == address
        return answer[7] & 0x0F, answer[8:]

    def _exactly(self, size: int) -> bytes:
        found = b""
        while len(found) < size:
            part = self.sock.recv(size - len(found))
            if not part:
                raise ConnectionError("the gateway has closed the connection")
            found += part
        return found


def frame(kind: int, address: int, body: bytes, counter: int = 2) -> bytes:
    """A frame of type 5."""
    mailbox = struct.pack("<HHBB", len(body), address, 0, kind | counter << 4) + body
    return struct.pack("<H", len(mailbox) | 0x5000) + mailbox


@contextmanager
def wire(host: str, *, tcp: bool = False, port: int = PORT) -> Iterator[Wire]:
    """Open a way to the gateway at *host*."""
    kind = socket.SOCK_STREAM if tcp else socket.SOCK_DGRAM
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.connect((host, port))
        yield Wire(sock, tcp)
