"""Rules that the servers of all mailbox protocols share: sizes, errors, counters (ETG.1000.4)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NoReturn, Protocol, Self, TypeVar

from devicebus.errors import MailboxRefusedError
from eap.codec.mailbox import MailboxError, MailboxHeader
from eap.errors import MalformedError, TruncatedError

T = TypeVar("T")

MINIMUM_SIZE = 16
"""Bytes of the smallest mailbox that holds the header of every protocol but AoE."""


class MailboxSizes:
    """Bytes of a slave's two mailboxes, mailbox header included; master and slave know both.

    The servers of one slave share one object, so that a new size holds for all of them.
    """

    __slots__ = ("to_master", "to_slave")

    def __init__(self, to_slave: int = 128, to_master: int = 128) -> None:
        self.set(to_slave, to_master)

    @classmethod
    def of_data(cls, size: int) -> Self:
        """Return mailboxes that hold *size* bytes behind their headers, both ways."""
        return cls(size + MailboxHeader.SIZE, size + MailboxHeader.SIZE)

    def set(self, to_slave: int, to_master: int) -> None:
        """Change both; raise ValueError if one is too small for a message."""
        if min(to_slave, to_master) < MINIMUM_SIZE:
            raise ValueError(
                f"mailboxes of {to_slave} and {to_master} bytes, expected at least {MINIMUM_SIZE}"
            )
        self.to_slave = to_slave
        self.to_master = to_master

    @property
    def data_to_master(self) -> int:
        """Bytes behind the mailbox header of the longest message to the master."""
        return self.to_master - MailboxHeader.SIZE


class ProtocolServer(Protocol):
    """One mailbox protocol on the side of the slave; data is what follows the mailbox header."""

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Act on a request and return the answers, in order.

        Raises MailboxRefusedError for what can only be answered with a mailbox error.
        """

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Take what nobody asked for."""

    def reset(self) -> None:
        """Forget every transfer: the mailbox starts again."""


def raise_mailbox_error(detail: MailboxError, reason: str) -> NoReturn:
    """Raise the MailboxRefusedError that answers a request with a mailbox error."""
    raise MailboxRefusedError(f"{detail.name}: {reason}", detail=detail)


def decode_or_error(decode: Callable[[bytes], T], data: bytes) -> T:
    """Return what *decode* makes of a message; what it cannot read gets a mailbox error."""
    try:
        return decode(data)
    except TruncatedError as exc:
        raise_mailbox_error(MailboxError.SIZE_TOO_SHORT, str(exc))
    except MalformedError as exc:
        raise_mailbox_error(MailboxError.SERVICE_NOT_SUPPORTED, str(exc))


def next_counter(counter: int) -> int:
    """Return the counter of the message behind the one with *counter*."""
    return counter % 7 + 1


class CounterCheck:
    """Judges the counters of one sender's messages.

    Attributes:
        repeated: Messages with the counter of the one before, which is what a repeat has.
        gaps: Times that at least one message seems to be missing.
    """

    __slots__ = ("_last", "gaps", "repeated")

    def __init__(self) -> None:
        self.repeated = 0
        self.gaps = 0
        self._last = 0

    def restart(self) -> None:
        """Take any counter next; the counts stay."""
        self._last = 0

    def is_new(self, counter: int) -> bool:
        """Count a message; say whether it is another one than the last."""
        last, self._last = self._last, counter
        if not counter or not last:
            return True
        if counter == last:
            self.repeated += 1
            return False
        if counter != next_counter(last):
            self.gaps += 1
        return True
