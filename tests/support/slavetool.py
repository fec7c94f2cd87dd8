"""A slave as pyads sees it, with octets instead of types."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import pyads

SDO, SOE = 0xF302, 0xF420
OPEN_READ, OPEN_WRITE, CLOSE, READ, WRITE, PROGRESS = range(0xF401, 0xF407)
_BUSY = 0x708


class Slave:
    """One slave, or a master, behind an open connection of pyads."""

    def __init__(self, connection: pyads.Connection) -> None:
        self._connection = connection

    def read(self, group: int, offset: int, size: int) -> bytes:
        octets = ctypes.c_ubyte * size
        return bytes(self._connection.read(group, offset, octets, check_length=False))

    def u32(self, group: int, offset: int) -> int:
        return int(self._connection.read(group, offset, pyads.PLCTYPE_UDINT))

    def write(self, group: int, offset: int, data: bytes = b"") -> None:
        kind = ctypes.c_ubyte * len(data) if data else None
        self._connection.write(group, offset, data or None, kind)

    def ask(self, group: int, offset: int, data: bytes, size: int) -> bytes:
        out, back = ctypes.c_ubyte * len(data), ctypes.c_ubyte * size
        if group == 0xF080:  # pyads wants to know better what is in a sum command
            return self._sum(group, offset, data, size)
        return bytes(self._connection.read_write(group, offset, back, data, out))

    def store(self, name: str, content: bytes, block: int = 64_000) -> None:
        """Write a file."""
        handle = self._open(OPEN_WRITE, name)
        for at in range(0, len(content), block):
            _patiently(self.write, WRITE, handle, content[at : at + block])
        _patiently(self.write, CLOSE, handle)

    def fetch(self, name: str, block: int = 64_000) -> bytes:
        """Read a file."""
        handle = self._open(OPEN_READ, name)
        content, done, is_complete = b"", 0, 0
        while not is_complete or len(content) < done:
            content += _patiently(self.read, READ, handle, block)
            done, is_complete = self._connection.read(PROGRESS, handle, pyads.PLCTYPE_UDINT * 2)
        self.write(CLOSE, handle)
        return content[:done]

    def _open(self, group: int, name: str) -> int:
        data = name.encode()
        return int.from_bytes(_patiently(self.ask, group, 0, data, 4), "little")

    def _sum(self, group: int, count: int, data: bytes, size: int) -> bytes:
        items = (pyads.structs.SAdsSumRequest * count).from_buffer_copy(data)
        kind = ctypes.c_ubyte * size
        return bytes(self._connection.read_write(group, count, kind, items, None))


def _patiently(ask: Callable[..., Any], *what: Any) -> Any:
    while True:
        try:
            return ask(*what)
        except pyads.ADSError as refusal:
            if refusal.err_code != _BUSY:
                raise
