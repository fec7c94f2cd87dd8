"""AMS packets out of a TCP connection, however its octets are cut."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from eap.codec.ams import AmsHeader
from eap.codec.amstcp import AmsTcpHeader, RouterCommand, decode_prefix
from eap.codec.wire import Buffer
from eap.errors import MalformedError


class TooLong(NamedTuple):
    """A packet over the limit: only its header is kept, the rest is thrown away as it comes."""

    header: AmsHeader
    length: int
    """Of the whole packet in octets, as its prefix says."""


class Asked(NamedTuple):
    """What a local client asks the router itself."""

    command: RouterCommand
    data: bytes


Piece: TypeAlias = bytes | TooLong | Asked

_COMMANDS = frozenset(RouterCommand)
_LONGEST_COMMAND = 16
"""Octets behind the prefix of one."""


class PacketCutter:
    """What a connection brought and has not been taken yet.

    It never holds more than one packet of the limit, one prefix, and what came last.

    Args:
        limit: Octets of the longest packet that is taken.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._buffer = bytearray()
        self._skip = 0

    @property
    def has_begun(self) -> bool:
        """Whether a packet has begun and is not whole."""
        return bool(self._buffer) or self._skip > 0

    def receive(self, data: Buffer) -> None:
        """Take what came."""
        skipped = min(self._skip, len(data))
        self._skip -= skipped
        self._buffer += memoryview(data)[skipped:]

    def receive_one(self, data: bytes) -> bytes | None:
        """Return the packet if *data* is exactly one, as it mostly is; else take what came."""
        start = AmsTcpHeader.SIZE
        end = len(data)
        # The limit is below 4 GB and no packet is empty, so these octets are the whole prefix.
        if (
            not self._buffer
            and not self._skip
            and start + AmsHeader.SIZE <= end <= start + self._limit
            and data[:start] == (end - start << 16).to_bytes(start, "little")
        ):
            return data[start:]
        self.receive(data)
        return None

    def next_piece(self) -> Piece | None:
        """Return the next whole packet, None if there is none yet.

        Raises:
            MalformedError: this is no stream of AMS packets; nothing can be cut from it any more.
        """
        start = AmsTcpHeader.SIZE
        if len(self._buffer) < start:
            return None
        if int.from_bytes(self._buffer[:2], "little") in _COMMANDS:
            return self._cut_command()
        length = decode_prefix(self._buffer)
        if length > self._limit:
            return self._cut_header(length)
        if len(self._buffer) < start + length:
            return None
        packet = bytes(self._buffer[start : start + length])
        del self._buffer[: start + length]
        return packet

    def _cut_command(self) -> Asked | None:
        start, prefix = AmsTcpHeader.SIZE, AmsTcpHeader.decode(self._buffer)
        end = start + prefix.length
        if prefix.length > _LONGEST_COMMAND:
            raise MalformedError(
                f"length {prefix.length} behind a command, expected {_LONGEST_COMMAND} or less",
                layout="AmsTcpHeader",
                offset=0,
            )
        if len(self._buffer) < end:
            return None
        asked = Asked(RouterCommand(prefix.reserved), bytes(self._buffer[start:end]))
        del self._buffer[:end]
        return asked

    def _cut_header(self, length: int) -> TooLong | None:
        start = AmsTcpHeader.SIZE
        if len(self._buffer) < start + AmsHeader.SIZE:
            return None
        header = AmsHeader.decode(self._buffer, start)
        here = min(start + length, len(self._buffer))
        self._skip = start + length - here
        del self._buffer[:here]
        return TooLong(header, length)
