"""What stands at the two sides of a station's router: services that answer, and carriers that send.

A *service* answers requests for a NetID of the station, at the AMS ports that it has.  A *carrier*
is the sending half of a door: it takes packets to a connection or an address.  Both are given to
:class:`~eap.appliance.services.routing.station_router.StationRouter`, which calls them from the
running loop only, so neither needs locks.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Container
from typing import NamedTuple, Protocol, TypeAlias

from eap.aoe.answer import AmsAnswer
from eap.aoe.way import Way
from eap.codec.ams import AmsHeader


class LocalRequest(NamedTuple):
    """A request for a service of this station; who asks may have it done.

    Access rules were applied before: what they refuse of a sum command is not in *body* any more.
    Notifications go to *came_by* by ``StationRouter.send_notification``.
    """

    header: AmsHeader
    body: bytes
    came_by: Way


AnswerNow: TypeAlias = Callable[[AmsHeader, bytes], AmsAnswer | None]
"""Returns the answer to a request, with its header and body, or None for "in the usual way"."""


class Service(Protocol):
    """Whoever answers behind a NetID.

    One that has a method ``answer_now``, an :data:`AnswerNow`, is asked by that first: what it says
    there goes back without anything being kept for the request.  It has to change nothing.
    """

    @property
    def ports(self) -> Container[int]:
        """AMS ports that it has now; they may change at any time."""

    def answer(self, request: LocalRequest) -> AmsAnswer | Awaitable[AmsAnswer]:
        """Answer a request: at once, or later by what is returned to be awaited.

        A method of ``async def`` will do; what is at hand is better returned as it is, without a
        task.  Of one client and target port only one request is under way at a time, others are
        at the same time.  An exception is logged and answered with ``AdsError.INTERNAL``; the
        router answers in its place what takes longer than its limit, and drops what comes then.
        """

    def client_gone(self, way: Way) -> None:
        """End what belongs to the clients of a connection that is closed: notifications, handles.

        An address without connections (a datagram's sender) is never closed.
        """


class Carrier(Protocol):
    """The sending half of a door."""

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send AMS packets, which are one or its fragments, without waiting.

        Args:
            connection: Name of a connection that came in, the sender's address where there are
                none, or the address of a hop that a route names.
            packets: With their headers, none longer than the room of the door.

        Returns:
            None, or why they cannot be sent; a request is answered with 0x1B then.
        """
