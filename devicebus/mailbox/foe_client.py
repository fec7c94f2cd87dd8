"""FoE as conversations: reading and writing files of a slave (ETG.1000.6).

A file is never held in memory: a read passes data to a sink and a write takes it from a source, one
message at a time.  Each message is sent after the answer to the one before.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from devicebus.errors import FoeError, MailboxProtocolError, MailboxSizeError, MailboxTimeoutError
from devicebus.mailbox.conversation import Conversation, MailboxRequest, Progress, reading
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.foe import (
    DATA_OVERHEAD,
    FoeErrorCode,
    FoeHeader,
    FoeOpcode,
    decode_message,
    encode_message,
    name_of,
    text_of,
)
from eap.codec.mailbox import MailboxType

STEP_TIMEOUT_NS = 3_000_000_000
"""Time-out for the answer to each message."""
BUSY_DELAY_NS = 10_000_000
BUSY_LIMIT = 6_000
"""Limit for consecutive busy answers: at least one minute."""
BUSY_TIMEOUT_NS = 120_000_000_000
"""Limit for the time that a slave stays busy, whatever the delay of its answers."""
MAX_SIZE = 1 << 28
"""Default limit for the size of a file that is read, in bytes."""


def read(
    name: str,
    sink: Callable[[bytes], object],
    sizes: MailboxSizes,
    *,
    password: int = 0,
    progress: Progress | None = None,
    max_size: int = MAX_SIZE,
) -> Conversation[int]:
    """Read a file into *sink* and return its size.

    An error raised by *sink* ends the transfer, also at the slave.

    Raises:
        FoeError: the slave refuses the transfer.
        MailboxProtocolError: an answer is invalid, or the file is longer than *max_size*.
        MailboxTimeoutError: the slave is busy for too long.
        MailboxSizeError: the name does not fit the mailbox.
    """
    transfer = _Transfer(f"FoE read of {name!r}")
    progress = progress or Progress()
    packet_size = sizes.to_master - DATA_OVERHEAD
    sent = _request(FoeOpcode.READ, password, name, sizes)
    expected = 1
    while True:
        header, data = yield from transfer.exchange(sent)
        if header.number != expected:
            yield from transfer.fail(
                FoeErrorCode.PACKET_NUMBER, f"packet {header.number}, expected {expected}"
            )
        if len(data) > packet_size or progress.done + len(data) > max_size:
            limit = min(packet_size, max_size - progress.done)
            yield from transfer.fail(
                FoeErrorCode.ILLEGAL, f"{len(data)} bytes, at most {limit} are accepted"
            )
        try:
            sink(data)
        except OSError:
            # Without it the slave would wait for an ACK and keep its file open.
            yield from transfer.send_error(FoeErrorCode.DISK_FULL)
            raise
        progress.done += len(data)
        sent = encode_message(FoeOpcode.ACK, expected)
        # A packet that is not full ends the file; a file of full packets ends with an empty one.
        if len(data) < packet_size:
            yield MailboxRequest(MailboxType.FOE, sent, expects_reply=False)
            return progress.done
        expected += 1


def write(
    name: str,
    source: Callable[[int], bytes],
    sizes: MailboxSizes,
    *,
    password: int = 0,
    progress: Progress | None = None,
) -> Conversation[int]:
    """Write a file from *source* and return its size.

    Args:
        name: Name of the file at the slave.
        source: Called with a number of bytes; returns as many or fewer, none at the end.
        sizes: Sizes of the slave's mailboxes.
        password: Password of the file, up to 32 bits.
        progress: Updated after each message.

    Raises:
        FoeError: the slave refuses the transfer.
        MailboxProtocolError: an answer is invalid.
        MailboxTimeoutError: the slave is busy for too long.
        MailboxSizeError: the name does not fit the mailbox.
    """
    transfer = _Transfer(f"FoE write of {name!r}")
    progress = progress or Progress()
    packet_size = sizes.to_slave - DATA_OVERHEAD
    sent = _request(FoeOpcode.WRITE, password, name, sizes)
    yield from transfer.exchange(sent)
    number = 0
    size = packet_size
    # A packet that is not full ends the file; after full packets only, it is an empty one.
    while size == packet_size:
        try:
            data = _read_fully(source, packet_size)
        except OSError:
            yield from transfer.send_error(FoeErrorCode.NOT_DEFINED)
            raise
        number += 1
        size = len(data)
        sent = encode_message(FoeOpcode.DATA, number, data)
        header, _ = yield from transfer.exchange(sent)
        if header.number != number:
            yield from transfer.fail(
                FoeErrorCode.PACKET_NUMBER,
                f"packet {header.number} acknowledged, expected {number}",
            )
        progress.done += size
    return progress.done


def _request(opcode: FoeOpcode, password: int, name: str, sizes: MailboxSizes) -> bytes:
    octets = name.encode()
    packet_size = sizes.to_slave - DATA_OVERHEAD
    if len(octets) > packet_size:
        raise MailboxSizeError(
            f"file name {name!r} has {len(octets)} bytes, the mailbox holds {packet_size}"
        )
    return encode_message(opcode, password, octets)


def _read_fully(source: Callable[[int], bytes], size: int) -> bytes:
    # A pipe may give fewer bytes than requested, and a short packet would end the file.
    data = source(size)
    while data and len(data) < size:
        more = source(size - len(data))
        if not more:
            break
        data += more
    return data


class _Transfer:
    """Message exchange of a read or a write."""

    def __init__(self, what: str) -> None:
        self.what = what

    def exchange(self, sent: bytes) -> Conversation[tuple[FoeHeader, bytes]]:
        """Send a message, again while the slave is busy; return header and body of the answer."""
        request = MailboxRequest(MailboxType.FOE, sent, timeout_ns=STEP_TIMEOUT_NS)
        since_ns: int | None = None
        times = 0
        while times < BUSY_LIMIT:
            message = yield request
            with reading(self.what):
                header, body = decode_message(message.data)
            if header.opcode is FoeOpcode.ERROR:
                raise self._error_of(header.number, text_of(body))
            if header.opcode is not FoeOpcode.BUSY:
                return header, bytes(body)
            times += 1
            since_ns = message.at_ns if since_ns is None else since_ns
            if message.at_ns - since_ns > BUSY_TIMEOUT_NS:
                break
            # BUSY acknowledges nothing: the same packet is sent again (ETG.1000.6).
            request = replace(request, delay_ns=BUSY_DELAY_NS)
        yield from self.send_error(FoeErrorCode.NOT_DEFINED)
        raise MailboxTimeoutError(f"{self.what}: still busy after {times} answers")

    def send_error(self, code: FoeErrorCode) -> Conversation[None]:
        """Send an error message, which ends the transfer at the slave."""
        yield MailboxRequest(
            MailboxType.FOE, encode_message(FoeOpcode.ERROR, code), expects_reply=False
        )

    def fail(self, code: FoeErrorCode, reason: str) -> Conversation[None]:
        """End the transfer at the slave and raise MailboxProtocolError."""
        yield from self.send_error(code)
        raise MailboxProtocolError(f"{self.what}: {reason}")

    def _error_of(self, code: int, text: str) -> FoeError:
        words = f", text of the slave {text!r}" if text else ""
        message = f"{self.what}: {name_of(code)} (0x{code:04X}){words}"
        return FoeError(message, code=code, text=text)
