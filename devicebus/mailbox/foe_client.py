"""FoE as conversations: the master's side of reading and writing files (ETG.1000.6).

A file is never held: what is read goes to a sink and what is written comes from a source, one
message at a time.  Each message waits for the answer to the one before.
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
"""How long the answer to each message may take."""
BUSY_DELAY_NS = 10_000_000
BUSY_LIMIT = 6_000
"""Times in a row that a slave may be busy: a minute, at least."""
BUSY_TIMEOUT_NS = 120_000_000_000
"""How long it may be busy, however long it takes to say so."""
MAX_SIZE = 1 << 28
"""Bytes of the largest file that is read unless told otherwise."""


def read(
    name: str,
    sink: Callable[[bytes], object],
    sizes: MailboxSizes,
    *,
    password: int = 0,
    progress: Progress | None = None,
    max_size: int = MAX_SIZE,
) -> Conversation[int]:
    """Read a file into *sink*, in the order of its bytes; return how many there were.

    What *sink* raises ends the transfer, also at the slave.

    Raises:
        FoeError: the slave refuses.
        MailboxProtocolError: it breaks the protocol, or the file is longer than *max_size*.
        MailboxTimeoutError: it is busy for too long.
        MailboxSizeError: the name does not fit the mailbox.
    """
    foe = _Transfer(f"FoE read of {name!r}")
    progress = progress or Progress()
    room = sizes.to_master - DATA_OVERHEAD
    sent = _request(FoeOpcode.READ, password, name, sizes)
    expected = 1
    while True:
        header, data = yield from foe.ask(sent)
        if header.number != expected:
            yield from foe.give_up(
                FoeErrorCode.PACKET_NUMBER, f"packet {header.number}, expected {expected}"
            )
        if len(data) > room or progress.done + len(data) > max_size:
            limit = min(room, max_size - progress.done)
            yield from foe.give_up(FoeErrorCode.ILLEGAL, f"{len(data)} bytes, taken are {limit}")
        try:
            sink(data)
        except OSError:
            yield from foe.tell(FoeErrorCode.DISK_FULL)
            raise
        progress.done += len(data)
        sent = encode_message(FoeOpcode.ACK, expected)
        if len(data) < room:
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
    """Write a file from *source*; return how many bytes there were.

    Args:
        name: Of the file, at the slave.
        source: Called with a number of bytes; returns as many or fewer, none at the end.
        sizes: Of the slave's mailboxes.
        password: Up to 32 bits.
        progress: What is told how far it is.

    Raises:
        FoeError: the slave refuses.
        MailboxProtocolError: it breaks the protocol.
        MailboxTimeoutError: it is busy for too long.
        MailboxSizeError: the name does not fit the mailbox.
    """
    foe = _Transfer(f"FoE write of {name!r}")
    progress = progress or Progress()
    room = sizes.to_slave - DATA_OVERHEAD
    sent = _request(FoeOpcode.WRITE, password, name, sizes)
    yield from foe.ask(sent)
    number = 0
    size = room
    while size == room:
        try:
            data = _take(source, room)
        except OSError:
            yield from foe.tell(FoeErrorCode.NOT_DEFINED)
            raise
        number += 1
        size = len(data)
        sent = encode_message(FoeOpcode.DATA, number, data)
        header, _ = yield from foe.ask(sent)
        if header.number != number:
            yield from foe.give_up(
                FoeErrorCode.PACKET_NUMBER, f"packet {header.number} confirmed, sent was {number}"
            )
        progress.done += size
    return progress.done


def _request(opcode: FoeOpcode, password: int, name: str, sizes: MailboxSizes) -> bytes:
    octets = name.encode()
    room = sizes.to_slave - DATA_OVERHEAD
    if len(octets) > room:
        raise MailboxSizeError(
            f"file name {name!r} has {len(octets)} bytes, the slave's mailbox has room for {room}"
        )
    return encode_message(opcode, password, octets)


def _take(source: Callable[[int], bytes], size: int) -> bytes:
    data = source(size)
    while data and len(data) < size:
        more = source(size - len(data))
        if not more:
            break
        data += more
    return data


class _Transfer:
    """What reading and writing have in common."""

    def __init__(self, what: str) -> None:
        self.what = what

    def ask(self, sent: bytes) -> Conversation[tuple[FoeHeader, bytes]]:
        """Send a message, again while the slave is busy; return header and body of the answer."""
        ask = MailboxRequest(MailboxType.FOE, sent, timeout_ns=STEP_TIMEOUT_NS)
        since_ns: int | None = None
        times = 0
        while times < BUSY_LIMIT:
            message = yield ask
            with reading(self.what):
                header, body = decode_message(message.data)
            if header.opcode is FoeOpcode.ERROR:
                raise self._refusal(header.number, text_of(body))
            if header.opcode is not FoeOpcode.BUSY:
                return header, bytes(body)
            times += 1
            since_ns = message.at_ns if since_ns is None else since_ns
            if message.at_ns - since_ns > BUSY_TIMEOUT_NS:
                break
            ask = replace(ask, delay_ns=BUSY_DELAY_NS)
        yield from self.tell(FoeErrorCode.NOT_DEFINED)
        raise MailboxTimeoutError(f"{self.what}: still busy after {times} answers")

    def tell(self, code: FoeErrorCode) -> Conversation[None]:
        """Tell the slave that the transfer is over."""
        yield MailboxRequest(
            MailboxType.FOE, encode_message(FoeOpcode.ERROR, code), expects_reply=False
        )

    def give_up(self, code: FoeErrorCode, reason: str) -> Conversation[None]:
        """Tell the slave and raise."""
        yield from self.tell(code)
        raise MailboxProtocolError(f"{self.what}: {reason}")

    def _refusal(self, code: int, text: str) -> FoeError:
        words = f", the slave says {text!r}" if text else ""
        message = f"{self.what}: {name_of(code)} (0x{code:04X}){words}"
        return FoeError(message, code=code, text=text)
