"""Rules that the servers of all mailbox protocols share: sizes and errors (ETG.1000.4)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NoReturn, Protocol, Self, TypeVar

from devicebus.errors import MailboxRefusedError
from eap.codec.mailbox import MailboxError, MailboxHeader
from eap.errors import MalformedError, TruncatedError

T = TypeVar("T")

# So many bytes hold the headers of every protocol but AoE.
MINIMUM_SIZE = 16
"""Smallest mailbox in bytes."""


class MailboxSizes:
    """Sizes of a slave's two mailboxes in bytes, mailbox header included.

    The servers of one slave share one object, so a new size applies to all of them.
    """

    __slots__ = ("to_master", "to_slave")

    def __init__(self, to_slave: int = 128, to_master: int = 128) -> None:
        self.set(to_slave, to_master)

    @classmethod
    def of_data(cls, size: int) -> Self:
        """Return sizes with *size* bytes of data, without the header, in both directions."""
        return cls(size + MailboxHeader.SIZE, size + MailboxHeader.SIZE)

    def set(self, to_slave: int, to_master: int) -> None:
        """Set both sizes; raise ValueError if one is too small for a message."""
        if min(to_slave, to_master) < MINIMUM_SIZE:
            raise ValueError(
                f"mailboxes of {to_slave} and {to_master} bytes, expected at least {MINIMUM_SIZE}"
            )
        self.to_slave = to_slave
        self.to_master = to_master

    @property
    def data_to_master(self) -> int:
        """Longest message to the master in bytes, without mailbox header."""
        return self.to_master - MailboxHeader.SIZE


class ProtocolServer(Protocol):
    """One mailbox protocol of a slave; messages are without mailbox header."""

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Handle a request and return its answers in order.

        Raises MailboxRefusedError for a request that is answered with a mailbox error.
        """

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Return and remove the unsolicited messages that are queued."""

    def reset(self) -> None:
        """Discard every transfer: the mailbox restarts."""


def raise_mailbox_error(detail: MailboxError, reason: str) -> NoReturn:
    """Raise the MailboxRefusedError that answers a request with a mailbox error."""
    raise MailboxRefusedError(f"{detail.name}: {reason}", detail=detail)


def decode_or_error(decode: Callable[[bytes], T], data: bytes) -> T:
    """Return the decoded message; raise the mailbox error of one that cannot be decoded."""
    try:
        return decode(data)
    except TruncatedError as exc:
        raise_mailbox_error(MailboxError.SIZE_TOO_SHORT, str(exc))
    except MalformedError as exc:
        raise_mailbox_error(MailboxError.SERVICE_NOT_SUPPORTED, str(exc))
