"""A slave's mailbox: protocols behind one pair of sync managers (ETG.1000.4).

Rules of all protocols: a request with the counter of the one before is dropped, a reply has the
address of its request and the slave's own counter, a request of an unsupported protocol is answered
with a mailbox error.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.conversation import CounterCheck, next_counter
from devicebus.mailbox.protocol import MailboxSizes, ProtocolServer, raise_mailbox_error
from eap.codec.mailbox import (
    MailboxError,
    MailboxErrorReply,
    MailboxHeader,
    MailboxType,
    encode_message,
)
from eap.codec.wire import Buffer

MAX_QUEUED = 8
"""Limit for queued replies; at this limit no further request is accepted."""


class MailboxServerStats(NamedTuple):
    """Counters of one mailbox since its creation."""

    received: int
    sent: int
    repeated_requests: int
    """Requests dropped because their counter was that of the request before."""
    gaps: int
    refused: int
    """Requests answered with a mailbox error."""
    repeated_replies: int
    """Replies sent again at the master's repeat request."""
    dropped: int
    """Requests received while the queue was full, or too short to be answered."""


class MailboxServer:
    """Mailbox of a slave; the caller moves whole messages between it and the memory.

    Args:
        protocols: Protocol servers of this slave.
        sizes: Mailbox sizes, shared with those servers.
    """

    def __init__(
        self, protocols: Mapping[MailboxType, ProtocolServer], sizes: MailboxSizes
    ) -> None:
        self.protocols = dict(protocols)
        self.sizes = sizes
        self._watch = CounterCheck()
        self._queue: deque[bytes] = deque()
        self._counter = 0
        self._offered: bytes | None = None
        self._last_read: bytes | None = None
        self._received = self._sent = self._refused = self._repeated = self._dropped = 0

    @property
    def is_ready(self) -> bool:
        """True while a request is accepted; otherwise it stays in the mailbox memory."""
        return len(self._queue) < MAX_QUEUED

    def start(self, to_slave: int, to_master: int) -> None:
        """Restart with mailboxes of these sizes; queued messages are discarded."""
        self.sizes.set(to_slave, to_master)
        self._watch.restart()
        self._queue.clear()
        self._counter = 0
        self._offered = self._last_read = None
        for protocol in self.protocols.values():
            protocol.reset()

    def receive_message(self, message: Buffer, now_ns: int) -> None:
        """Handle a message with its header; bytes after its length are ignored."""
        if len(message) < MailboxHeader.SIZE or not self.is_ready:
            self._dropped += 1
            return
        self._received += 1
        # A repeated counter is a repetition by the data link layer: the request was handled
        # already.
        if not self._watch.is_new(message[5] >> 4 & 7):
            return
        # Gateways and this project's master recognize their replies by the echoed address.
        address = int.from_bytes(message[2:4], "little")
        try:
            kind, replies = self._dispatch(message, now_ns)
        except MailboxRefusedError as exc:
            self._refused += 1
            kind, replies = MailboxType.ERR, [MailboxErrorReply(detail=exc.detail).encode()]
        for data in replies:
            self._enqueue(kind, data, address)

    def next_message(self, now_ns: int) -> bytes | None:
        """Return and remove the next message for the empty mailbox to the master."""
        if not self._queue:
            # Replies come first: unsolicited messages, with address 0, wait until none is queued.
            for kind, protocol in self.protocols.items():
                for data in protocol.messages_to_send(now_ns):
                    self._enqueue(kind, data, 0)
        self._offered = self._queue.popleft() if self._queue else None
        self._sent += self._offered is not None
        return self._offered

    def handle_read(self) -> None:
        """Handle the master's read of the mailbox."""
        if self._offered is not None:
            self._last_read, self._offered = self._offered, None

    def repeat_message(self) -> bytes | None:
        """Return the message that the master read last, to be offered again.

        A newer message that is in the mailbox already follows later.  None: the master has read
        nothing so far, and the mailbox stays unchanged.
        """
        if self._last_read is None:
            return None
        if self._offered is not None:
            self._queue.appendleft(self._offered)
            self._sent -= 1
        # A newer message stays in front of the queue: it follows the repetition.
        self._offered = self._last_read
        self._repeated += 1
        return self._offered

    def stats(self) -> MailboxServerStats:
        """Return the counters."""
        return MailboxServerStats(
            self._received,
            self._sent,
            self._watch.repeated,
            self._watch.gaps,
            self._refused,
            self._repeated,
            self._dropped,
        )

    def _dispatch(self, message: Buffer, now_ns: int) -> tuple[MailboxType, list[bytes]]:
        length = int.from_bytes(message[:2], "little")
        max_length = min(len(message), self.sizes.to_slave) - MailboxHeader.SIZE
        if not 0 < length <= max_length:
            raise_mailbox_error(
                MailboxError.INVALID_HEADER, f"length {length}, expected 1 to {max_length}"
            )
        if message[4] & 0x3F:
            raise_mailbox_error(
                MailboxError.INVALID_CHANNEL, f"channel {message[4] & 0x3F}, expected 0"
            )
        number = message[5] & 0x0F
        if number == MailboxType.ERR:
            raise_mailbox_error(MailboxError.INVALID_HEADER, "type 0 is no request")
        try:
            kind = MailboxType(number)
            protocol = self.protocols[kind]
        except (KeyError, ValueError):
            raise_mailbox_error(MailboxError.UNSUPPORTED_PROTOCOL, f"type {number}")
        data = bytes(message[MailboxHeader.SIZE : MailboxHeader.SIZE + length])
        return kind, protocol.receive_message(data, now_ns)

    def _enqueue(self, kind: MailboxType, data: bytes, address: int) -> None:
        # A protocol could not divide the answer: an error is better than a cut message.
        if len(data) > self.sizes.data_to_master:
            self._refused += 1
            kind, data = (
                MailboxType.ERR,
                MailboxErrorReply(detail=MailboxError.INVALID_SIZE).encode(),
            )
        self._counter = next_counter(self._counter)
        header = MailboxHeader(0, address, type=kind, counter=self._counter)
        self._queue.append(encode_message(header, data))
