"""Turns at something that only one may use at a time: requesters are served round robin.

Whoever asks often does not keep out who asks seldom: behind each turn comes the next requester, not
the next request.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Hashable


class Turns:
    """Who may use which thing now."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, dict[Hashable, deque[asyncio.Future[None]]]] = {}

    async def take(self, thing: Hashable, requester: Hashable) -> None:
        """Wait for a turn, which lasts until :meth:`give_back`; cancelling it gives up the wait."""
        if thing not in self._waiting:
            self._waiting[thing] = {}
            return
        turn = asyncio.get_running_loop().create_future()
        self._waiting[thing].setdefault(requester, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():  # it came in the same moment
                self.give_back(thing)
            raise

    def give_back(self, thing: Hashable) -> None:
        """End a turn: the next requester has the next."""
        requesters = self._waiting[thing]
        while requesters:
            requester = next(iter(requesters))
            turns = requesters.pop(requester)
            turn = turns.popleft()
            if turns:
                requesters[requester] = turns
            if not turn.done():
                turn.set_result(None)
                return
        del self._waiting[thing]
