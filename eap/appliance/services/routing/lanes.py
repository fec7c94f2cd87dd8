"""Requests for services: those of one client to one port in their order, all others side by side.

Rule: what waits is bounded in number and octets; who is too many is told at once.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Awaitable, Callable
from typing import NamedTuple, TypeAlias

from eap.aoe.answer import AmsAnswer
from eap.aoe.way import Way
from eap.appliance.services.routing.service import LocalRequest, Service
from eap.appliance.services.tasks import TaskSet
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader

MAX_WAITING = 64
"""Requests of one client to one port that wait for their turn."""
MAX_OCTETS = 16 << 20
"""Octets of all requests of a station that are under way or wait."""
_FAILED = AmsAnswer(error_code=AdsError.INTERNAL)
_FULL = AmsAnswer(error_code=AdsError.MAILBOX_FULL)

Finish: TypeAlias = Callable[[int, AmsAnswer], None]
"""Takes the answer to the request with a ticket."""
_Key: TypeAlias = tuple[Way, bytes]

logger = logging.getLogger(__name__)


class _Waiting(NamedTuple):
    ticket: int
    service: Service
    request: LocalRequest


class Lanes:
    """All requests of one station's services; *finish* gets their answers."""

    def __init__(self, finish: Finish) -> None:
        self._finish = finish
        self._lanes: dict[_Key, deque[_Waiting]] = {}
        self._tasks = TaskSet("AoE requests")
        self._octets = 0

    def has_work(self, way: Way, header: AmsHeader) -> bool:
        """Say whether something is under way, or waits, of the client and port of a request."""
        return bool(self._lanes) and (way, _addresses(header)) in self._lanes

    def put(self, ticket: int, service: Service, request: LocalRequest) -> None:
        """Have *service* answer a request when its turn comes."""
        key = request.came_by, _addresses(request.header)
        waiting = _Waiting(ticket, service, request)
        lane = self._lanes.get(key)
        if lane is None:
            answer = _begin(waiting)
            if isinstance(answer, AmsAnswer):
                self._finish(ticket, answer)
                return
            self._lanes[key] = lane = deque()
            self._octets += len(request.body)
            self._tasks.start(self._run(key, lane, waiting, answer))
        elif len(lane) >= MAX_WAITING or self._octets + len(request.body) > MAX_OCTETS:
            self._finish(ticket, _FULL)
        else:
            self._octets += len(request.body)
            lane.append(waiting)

    def forget(self, way: Way) -> None:
        """Leave out what waits for its turn and came by *way*; what has begun goes on."""
        for key, lane in self._lanes.items():
            if key[0] == way:
                self._octets -= sum(len(each.request.body) for each in lane)
                lane.clear()

    async def close(self) -> None:
        """Give up what is under way."""
        await self._tasks.close()

    async def _run(
        self, key: _Key, lane: deque[_Waiting], first: _Waiting, answer: Awaitable[AmsAnswer]
    ) -> None:
        """Answer what is in *lane* until nothing is."""
        waiting: _Waiting = first
        outcome: AmsAnswer | Awaitable[AmsAnswer] = answer
        try:
            while True:
                if not isinstance(outcome, AmsAnswer):
                    outcome = await _end(waiting, outcome)
                self._octets -= len(waiting.request.body)
                self._finish(waiting.ticket, outcome)
                if not lane:
                    return
                waiting = lane.popleft()
                outcome = _begin(waiting)
        finally:
            del self._lanes[key]


def _begin(waiting: _Waiting) -> AmsAnswer | Awaitable[AmsAnswer]:
    try:
        return waiting.service.answer(waiting.request)
    except Exception:
        logger.exception("AoE request from %s failed", waiting.request.header.source)
        return _FAILED


async def _end(waiting: _Waiting, answer: Awaitable[AmsAnswer]) -> AmsAnswer:
    try:
        return await answer
    except Exception:
        logger.exception("AoE request from %s failed", waiting.request.header.source)
        return _FAILED


def _addresses(header: AmsHeader) -> bytes:
    ports = header.target_port << 16 | header.source_port
    return header.target + header.source + ports.to_bytes(4, "little")
