"""AMS packets put together and taken apart by ``struct``, apart from our codec."""

from __future__ import annotations

import struct
from typing import NamedTuple

_AMS = struct.Struct("<6sH6sHHHIII")
READ, ADD_NOTIFICATION, DELETE_NOTIFICATION, NOTIFICATION, READ_WRITE = 2, 6, 7, 8, 9


class Ams(NamedTuple):
    """One packet."""

    target: str
    source: str
    """NetID and port, ``5.1.1.1.1.1:851``."""
    command: int = READ
    flags: int = 4
    error: int = 0
    invoke_id: int = 1
    body: bytes = b""

    def octets(self) -> bytes:
        target, source = _address(self.target), _address(self.source)
        return _AMS.pack(*target, *source, self.command, self.flags, len(self.body), self.error,
                         self.invoke_id) + self.body  # fmt: skip

    def answer(self, body: bytes = b"\0\0\0\0", error: int = 0) -> Ams:
        return self._replace(
            target=self.source, source=self.target, flags=self.flags | 1, error=error, body=body
        )


def parse(packet: bytes) -> Ams:
    target, target_port, source, source_port, command, flags, length, error, invoke_id = (
        _AMS.unpack_from(packet)
    )
    body = packet[_AMS.size :]
    assert len(body) == length
    return Ams(_text(target, target_port), _text(source, source_port), command, flags, error,
               invoke_id, body)  # fmt: skip


def _address(text: str) -> tuple[bytes, int]:
    net_id, _, port = text.partition(":")
    return bytes(int(part) for part in net_id.split(".")), int(port)


def _text(net_id: bytes, port: int) -> str:
    return f"{'.'.join(map(str, net_id))}:{port}"
