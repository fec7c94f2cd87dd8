"""What a router wants done with packets, and what it has to tell."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple, TypeAlias

from eap.ads.endpoint import Endpoint
from eap.codec.ams import AmsHeader


class Forward(NamedTuple):
    """A request for the next hop."""

    hop: Endpoint
    packets: tuple[bytes, ...]
    """One, or its fragments in their order."""
    ticket: int
    """Names the request, for a door that cannot send it."""


class Reply(NamedTuple):
    """An answer or a notification, for the connection that it belongs to."""

    endpoint: Endpoint
    packets: tuple[bytes, ...]
    """One, or its fragments in their order."""


class Deliver(NamedTuple):
    """A request for a service of this station."""

    ticket: int
    """Names the request, for its answer."""
    header: AmsHeader
    body: bytes
    came_by: Endpoint
    """Where notifications go, if it is about any."""


Action: TypeAlias = Forward | Reply | Deliver


class Outcome(StrEnum):
    """What became of a packet."""

    ANSWERED = "answered"
    FAILED = "failed"
    """The router itself answered, with an error."""
    DENIED = "denied"
    """Access rules forbid it, or items of it."""
    LOOP = "loop"
    """It ran in a circle; if it was a request it was answered with an error."""
    LATE = "late"
    """An answer or a notification that nobody waits for, or not any more."""
    DROPPED = "dropped"
    """Nothing was answered: broken, doubled, or of the kind that has no answer."""
    INTERRUPTED = "interrupted"
    """Nothing comes for subscriptions any more; they are to be restored."""
    RESTORED = "restored"
    """Subscriptions that were interrupted are established again."""


class Trace(NamedTuple):
    """What became of one packet; *text* is for people and names the hop where there is one."""

    at_ns: int
    outcome: Outcome
    came_by: Endpoint | None
    """None if its connection is gone."""
    hop: Endpoint | None
    """None if it went no further."""
    header: AmsHeader | None
    """Of the request, as it came; None if it could not be read."""
    error_code: int
    """Of the AMS header of the answer."""
    took_ns: int
    text: str
