"""AMS packets put together from a TCP stream or from AoE fragments, in bounded memory (ETG.1020).

Each fragment is a packet of its own, with the addresses of the whole packet; the first one carries
the rest of its header, from the command on, in front of the data.  The invoke ID holds the number
of the fragment in its low word and that of the packet in its high word.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from typing import NamedTuple, TypeAlias

from eap.codec.ams import (
    AmsCommand,
    AmsHeader,
    AmsTcpHeader,
    RouterCommand,
    StateFlags,
    decode_prefix,
    encode_packet,
)
from eap.codec.wire import Buffer
from eap.errors import MalformedError
from eap.ids import Endpoint, NetId


class OversizedPacket(NamedTuple):
    """A packet over the limit: only its header is kept, the rest is thrown away as it comes."""

    header: AmsHeader
    length: int
    """Of the whole packet in bytes, as its prefix says."""


class RouterRequest(NamedTuple):
    """Command of a local client to the router itself."""

    command: RouterCommand
    data: bytes


StreamItem: TypeAlias = bytes | OversizedPacket | RouterRequest

_COMMANDS = frozenset(RouterCommand)
_LONGEST_COMMAND = 16
"""Bytes behind the prefix of one."""


class StreamDecoder:
    """Received bytes of one connection, from which a decoder cuts packets.

    It never holds more than one packet of the limit, one prefix, and what came last.

    Args:
        limit: Bytes of the longest packet that is taken.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._buffer = bytearray()
        self._skip = 0

    @property
    def has_begun(self) -> bool:
        """True if a packet has begun and is not complete."""
        return bool(self._buffer) or self._skip > 0

    def receive(self, data: Buffer) -> None:
        """Append received bytes."""
        skipped = min(self._skip, len(data))
        self._skip -= skipped
        self._buffer += memoryview(data)[skipped:]


class AmsStreamDecoder(StreamDecoder):
    """Decoder of the AMS packets in one TCP connection."""

    def receive_one(self, data: bytes) -> bytes | None:
        """Return the packet if *data* is exactly one, as usual; else append *data*."""
        start = AmsTcpHeader.SIZE
        end = len(data)
        # The limit is below 4 GB and no packet is empty, so these bytes are the whole prefix.
        if (
            not self._buffer
            and not self._skip
            and start + AmsHeader.SIZE <= end <= start + self._limit
            and data[:start] == (end - start << 16).to_bytes(start, "little")
        ):
            return data[start:]
        self.receive(data)
        return None

    def next_item(self) -> StreamItem | None:
        """Return the next complete packet, None if there is none yet.

        Raises:
            MalformedError: this is no stream of AMS packets; nothing can be cut from it any more.
        """
        start = AmsTcpHeader.SIZE
        if len(self._buffer) < start:
            return None
        # Local clients put a router command where the prefix has its 0; no AMS header follows it.
        if int.from_bytes(self._buffer[:2], "little") in _COMMANDS:
            return self._cut_command()
        length = decode_prefix(self._buffer)
        # The packet is skipped, not the connection: its sender still gets an answer by the header.
        if length > self._limit:
            return self._cut_header(length)
        if len(self._buffer) < start + length:
            return None
        packet = bytes(self._buffer[start : start + length])
        del self._buffer[: start + length]
        return packet

    def _cut_command(self) -> RouterRequest | None:
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
        request = RouterRequest(RouterCommand(prefix.reserved), bytes(self._buffer[start:end]))
        del self._buffer[:end]
        return request

    def _cut_header(self, length: int) -> OversizedPacket | None:
        start = AmsTcpHeader.SIZE
        if len(self._buffer) < start + AmsHeader.SIZE:
            return None
        header = AmsHeader.decode(self._buffer, start)
        here = min(start + length, len(self._buffer))
        self._skip = start + length - here
        del self._buffer[:here]
        return OversizedPacket(header, length)


class BareAmsDecoder(StreamDecoder):
    """Decoder of AMS packets without a prefix, as they are inside TLS (Secure ADS)."""

    def receive_one(self, data: bytes) -> bytes | None:
        """Return the packet if *data* is exactly one, as usual; else append *data*."""
        if (
            not self._buffer
            and not self._skip
            and AmsHeader.SIZE <= len(data) <= self._limit
            and data[:2] != _NO_NET_ID
            and int.from_bytes(data[_BODY_LENGTH], "little") == len(data) - AmsHeader.SIZE
        ):
            return data
        self.receive(data)
        return None

    def next_item(self) -> StreamItem | None:
        """Return the next complete packet, None if there is none yet.

        Raises:
            MalformedError: this is no stream of AMS packets; nothing can be cut from it any more.
        """
        if len(self._buffer) < AmsHeader.SIZE:
            return None
        # A length in a wrong place would be read as one of gigabytes otherwise.
        if self._buffer[:2] == _NO_NET_ID:
            raise MalformedError(
                "target NetID 0.0, expected a packet without the prefix of AMS/TCP",
                layout="AmsHeader",
            )
        length = AmsHeader.SIZE + int.from_bytes(self._buffer[_BODY_LENGTH], "little")
        here = min(length, len(self._buffer))
        if length > self._limit:
            oversized = OversizedPacket(AmsHeader.decode(self._buffer), length)
            self._skip = length - here
            del self._buffer[:here]
            return oversized
        if here < length:
            return None
        packet = bytes(self._buffer[:length])
        del self._buffer[:length]
        return packet


_NO_NET_ID = bytes(2)
"""First bytes of no NetID of a router, but of the prefix of AMS/TCP."""
_BODY_LENGTH = slice(20, 24)
"""Place of the length of the body in the AMS header."""
FRAGMENT_TIMEOUT_NS = 2_000_000_000
"""Limit for the next fragment; the packet is dropped then."""
MAX_PACKETS = 8
"""Incomplete packets kept at a time; the oldest is dropped for a new one."""
MAX_LENGTH = 1 << 20
"""Bytes of the longest packet that is put together."""
_ADDRESSES = 16
"""Bytes of a header that every fragment repeats."""
_REST = AmsHeader.SIZE - _ADDRESSES


def iter_fragments(packet: bytes, number: int, max_size: int) -> Iterator[bytes]:
    """Yield the packets that carry *packet*, each with at most *max_size* bytes of it.

    They are not acknowledged.

    Args:
        packet: A whole packet.
        number: Of the packet, another one for each; 16 bits count.
        max_size: Bytes behind the header of each.
    """
    header = AmsHeader.decode(packet)
    # Each fragment repeats the addresses; the rest of the original header goes with the data.
    content = packet[_ADDRESSES:]
    for fragment, at in enumerate(range(0, len(content), max_size)):
        head = AmsHeader(
            header.target,
            header.target_port,
            header.source,
            header.source_port,
            AmsCommand.FRAGMENT,
            StateFlags.ADS | StateFlags.NO_RETURN,
            invoke_id=(number & 0xFFFF) << 16 | fragment,
        )
        yield encode_packet(head, content[at : at + max_size])


class _PartialPacket:
    """Incomplete packet."""

    __slots__ = ("content", "deadline_ns", "next")

    def __init__(self) -> None:
        self.content = bytearray()
        self.next = 0
        self.deadline_ns = 0


class ReassemblyResult(NamedTuple):
    """Result of a fragment."""

    packet: bytes | None
    """The whole packet, if this was its last fragment."""
    acknowledgement: bytes | None
    """Acknowledgement that the sender waits for before its next fragment."""


class FragmentAssembler:
    """Puts fragments together again.

    Attributes:
        dropped: Packets of which fragments were missing, late, or did not fit together.
        octets: Kept of the packets that are not complete.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self.octets = 0
        self._partial: dict[tuple[int, NetId, int], _PartialPacket] = {}

    def reset(self) -> None:
        """Forget the packets that are not complete."""
        self._partial.clear()
        self.octets = 0

    def __len__(self) -> int:
        return len(self._partial)

    def receive(self, header: AmsHeader, body: bytes, now_ns: int) -> ReassemblyResult:
        """Add the fragment with *header* and *body*.

        Raises:
            MalformedError: one before it is missing, or the whole is longer than it says.
        """
        number, fragment = header.invoke_id >> 16, header.invoke_id & 0xFFFF
        key = number, header.source, header.source_port
        self.expire(now_ns)
        # Fragment 0 always begins anew: packet numbers of 16 bits repeat.
        if fragment == 0:
            self._start(key)
        partial = self._partial.get(key)
        if partial is None or partial.next != fragment:
            self._drop(key)
            raise MalformedError(f"fragment {fragment} of packet {number} out of order",
                                 layout="AmsHeader")  # fmt: skip
        partial.content += body
        self.octets += len(body)
        partial.next += 1
        partial.deadline_ns = now_ns + FRAGMENT_TIMEOUT_NS
        missing = _missing(partial.content)
        if missing < 0:
            self._drop(key)
            raise MalformedError(f"packet {number} is {-missing} bytes too long",
                                 layout="AmsHeader")  # fmt: skip
        if missing:
            return ReassemblyResult(None, _acknowledge(header))
        self._forget(key)
        return ReassemblyResult(header.encode()[:_ADDRESSES] + bytes(partial.content), None)

    def expire(self, now_ns: int) -> None:
        """Forget the packets whose next fragment is late."""
        for key in [key for key, each in self._partial.items() if now_ns > each.deadline_ns]:
            self._drop(key)

    def _start(self, key: tuple[int, NetId, int]) -> None:
        if key in self._partial:
            self._drop(key)
        elif len(self._partial) >= MAX_PACKETS:
            self._drop(next(iter(self._partial)))
        self._partial[key] = _PartialPacket()

    def _drop(self, key: tuple[int, NetId, int]) -> None:
        self._forget(key)
        self.dropped += 1

    def _forget(self, key: tuple[int, NetId, int]) -> None:
        partial = self._partial.pop(key, None)
        if partial is not None:
            self.octets -= len(partial.content)


def _missing(content: bytearray) -> int:
    """Return the number of missing bytes; at least one while the length is unknown."""
    if len(content) < _REST:
        return _REST - len(content)
    length = int.from_bytes(content[4:8], "little")
    # Refused by its first fragment, before memory is spent on the others.
    if length > MAX_LENGTH:
        return MAX_LENGTH - length
    return _REST + length - len(content)


def _acknowledge(header: AmsHeader) -> bytes | None:
    if header.state_flags & StateFlags.NO_RETURN:
        return None
    return AmsHeader(
        header.source,
        header.source_port,
        header.target,
        header.target_port,
        header.command,
        header.state_flags | StateFlags.RESPONSE,
        invoke_id=header.invoke_id,
    ).encode()


MAX_SENDERS = 64
"""Endpoints with fragments at a time; the one that began first is dropped."""
MAX_OCTETS = 16 << 20
"""Bytes kept in all; a sender whose fragment exceeds it loses all its fragments."""


class Reassembly:
    """Fragment assemblers, one for each endpoint.

    Fragments of different endpoints never mix, and an endpoint can displace only its own as long as
    fewer than 64 send.

    Attributes:
        dropped: Packets that were not put together.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._senders: OrderedDict[Endpoint, FragmentAssembler] = OrderedDict()
        self._octets = 0

    @property
    def octets(self) -> int:
        """Bytes that are kept."""
        return self._octets

    def receive(
        self, endpoint: Endpoint, header: AmsHeader, body: bytes, now_ns: int
    ) -> ReassemblyResult:
        """Add a fragment from *endpoint*.

        Raises:
            MalformedError: it does not fit to the one before it, the whole is too long, or too
                much is kept already.
        """
        assembler = self._assembler_of(endpoint, now_ns)
        before = assembler.octets, assembler.dropped
        try:
            taken = assembler.receive(header, body, now_ns)
        finally:
            self._account(endpoint, assembler, before)
        if self._octets > MAX_OCTETS:
            self._drop(endpoint)
            raise MalformedError(
                f"{MAX_OCTETS} bytes of fragments are kept already", layout="AmsHeader"
            )
        return taken

    def forget(self, endpoint: Endpoint) -> None:
        """Forget the fragments from *endpoint*."""
        assembler = self._senders.pop(endpoint, None)
        if assembler is not None:
            self._octets -= assembler.octets

    def _assembler_of(self, endpoint: Endpoint, now_ns: int) -> FragmentAssembler:
        assembler = self._senders.get(endpoint)
        if assembler is not None:
            return assembler
        if len(self._senders) >= MAX_SENDERS:
            self._expire(now_ns)
        if len(self._senders) >= MAX_SENDERS:
            self._drop(next(iter(self._senders)))
        assembler = self._senders[endpoint] = FragmentAssembler()
        return assembler

    def _expire(self, now_ns: int) -> None:
        for endpoint, assembler in list(self._senders.items()):
            before = assembler.octets, assembler.dropped
            assembler.expire(now_ns)
            self._account(endpoint, assembler, before)

    def _account(
        self, endpoint: Endpoint, assembler: FragmentAssembler, before: tuple[int, int]
    ) -> None:
        self._octets += assembler.octets - before[0]
        self.dropped += assembler.dropped - before[1]
        if not len(assembler):
            self.forget(endpoint)

    def _drop(self, endpoint: Endpoint) -> None:
        self.dropped += len(self._senders[endpoint])
        self.forget(endpoint)
