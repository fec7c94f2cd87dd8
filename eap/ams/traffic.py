"""What went by each way: the figures of a table of routes and connections."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

import msgspec

from eap.ids import NetId

MAX_WAYS = 4096
"""Ways that are counted at a time; the one that was there first makes room."""
MAX_SOURCES = 8
"""NetIDs that are remembered of those who ask by one way."""

KeyT = TypeVar("KeyT", bound=Hashable)


class Traffic(msgspec.Struct):
    """Packets of one way, in one direction of asking.

    Attributes:
        since_ns: When it was used first.
        requests: That went there, or came from there.
        answers: That came from there, or went there.
        errors: Requests that did not get to their targets.
        octets_asked: Octets of the requests.
        octets_answered: Octets of the answers.
        round_trip_ns: Of the latest answer.
        last_error: In words.
        sources: NetIDs that asked, the first of them.
        is_answered: Whether the latest of the requests that are over was answered.
    """

    since_ns: int = 0
    requests: int = 0
    answers: int = 0
    errors: int = 0
    octets_asked: int = 0
    octets_answered: int = 0
    round_trip_ns: int = 0
    last_error: str = ""
    sources: tuple[NetId, ...] = ()
    is_answered: bool = False

    def ask(self, octets: int, source: NetId | None = None) -> None:
        """Count a request."""
        self.requests += 1
        self.octets_asked += octets
        if source is not None and source not in self.sources and len(self.sources) < MAX_SOURCES:
            self.sources += (source,)

    def answer(self, octets: int, took_ns: int) -> None:
        """Count an answer."""
        self.answers += 1
        self.octets_answered += octets
        self.round_trip_ns = took_ns
        self.is_answered = True

    def fail(self, text: str) -> None:
        """Count a request that did not get to its target."""
        self.errors += 1
        self.last_error = text
        self.is_answered = False


class TrafficTable(Generic[KeyT]):
    """The traffic of all ways, by what they are known by."""

    def __init__(self) -> None:
        self._endpoints: OrderedDict[KeyT, Traffic] = OrderedDict()

    def of(self, endpoint: KeyT, now_ns: int) -> Traffic:
        """Return the traffic of *endpoint*, which may be new."""
        traffic = self._endpoints.get(endpoint)
        if traffic is None:
            if len(self._endpoints) >= MAX_WAYS:
                self._endpoints.popitem(last=False)
            traffic = self._endpoints[endpoint] = Traffic(now_ns)
        return traffic

    def get(self, endpoint: KeyT) -> Traffic | None:
        """Return a copy of the traffic of *endpoint*, None if it was never used."""
        traffic = self._endpoints.get(endpoint)
        return None if traffic is None else msgspec.structs.replace(traffic)

    def forget(self, endpoint: KeyT) -> None:
        """Leave *endpoint* out from now on: it is closed."""
        self._endpoints.pop(endpoint, None)

    def snapshot(self) -> dict[KeyT, Traffic]:
        """Return a copy of all."""
        return {
            endpoint: msgspec.structs.replace(each) for endpoint, each in self._endpoints.items()
        }
