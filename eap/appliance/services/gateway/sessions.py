"""The sessions of all clients of a gateway: each with one slave, or the master, in one protocol."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Generic, NamedTuple, Protocol, TypeVar

from eap.aoe.way import Way
from eap.codec.mailbox import MailboxType

MAX_SESSIONS = 512


class SessionKey(NamedTuple):
    """Whose session it is, with whom, and in which protocol."""

    way: Way
    address: int
    """Station address, virtual address, or 0 for the master."""
    kind: MailboxType


class Session(Protocol):
    """What all kinds of sessions have in common."""

    @property
    def is_running(self) -> bool:
        """Whether a transfer is under way."""

    def close(self) -> None:
        """End what is under way."""


S = TypeVar("S", bound=Session)


class Sessions(Generic[S]):
    """Sessions of one kind, at most MAX_SESSIONS; the one that was not used for longest goes."""

    def __init__(self) -> None:
        self._open: dict[SessionKey, S] = {}

    def take(self, key: SessionKey, begin: Callable[[], S]) -> S:
        """Return the session of *key*, a new one if there is none."""
        session = self._open.pop(key, None)
        if session is None:
            if len(self._open) >= MAX_SESSIONS:
                self._drop_oldest()
            session = begin()
        self._open[key] = session  # at the end: at the front is who has asked nothing for longest
        return session

    def running(self) -> Iterator[SessionKey]:
        """Yield those that have a transfer under way."""
        return (key for key, session in self._open.items() if session.is_running)

    def close_of(self, way: Way) -> None:
        """End what a client has under way, and forget it."""
        for key in [key for key in self._open if key.way == way]:
            self._open.pop(key).close()

    def close(self) -> None:
        """End and forget all."""
        while self._open:
            self._open.popitem()[1].close()

    def _drop_oldest(self) -> None:
        idle = (key for key, each in self._open.items() if not each.is_running)
        self._open.pop(next(idle, next(iter(self._open)))).close()
