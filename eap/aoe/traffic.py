"""What went by each way: the figures of a table of routes and connections."""

from __future__ import annotations

from collections import OrderedDict

import msgspec

from eap.aoe.way import Way

MAX_WAYS = 4096
"""Ways that are counted at a time; the one that was there first makes room."""


class Traffic(msgspec.Struct):
    """Packets of one way, in one direction of asking.

    Attributes:
        requests: That went there, or came from there.
        answers: That came from there, or went there.
        errors: Requests that did not get to their targets.
        octets_asked: Octets of the requests.
        octets_answered: Octets of the answers.
        round_trip_ns: Of the latest answer.
        last_error: In words.
    """

    requests: int = 0
    answers: int = 0
    errors: int = 0
    octets_asked: int = 0
    octets_answered: int = 0
    round_trip_ns: int = 0
    last_error: str = ""

    def ask(self, octets: int) -> None:
        """Count a request."""
        self.requests += 1
        self.octets_asked += octets

    def answer(self, octets: int, took_ns: int) -> None:
        """Count an answer."""
        self.answers += 1
        self.octets_answered += octets
        self.round_trip_ns = took_ns

    def fail(self, text: str) -> None:
        """Count a request that did not get to its target."""
        self.errors += 1
        self.last_error = text


class TrafficTable:
    """The traffic of all ways."""

    def __init__(self) -> None:
        self._ways: OrderedDict[Way, Traffic] = OrderedDict()

    def of(self, way: Way) -> Traffic:
        """Return the traffic of *way*, which may be new."""
        traffic = self._ways.get(way)
        if traffic is None:
            if len(self._ways) >= MAX_WAYS:
                self._ways.popitem(last=False)
            traffic = self._ways[way] = Traffic()
        return traffic

    def forget(self, way: Way) -> None:
        """Leave *way* out from now on: it is closed."""
        self._ways.pop(way, None)

    def snapshot(self) -> dict[Way, Traffic]:
        """Return a copy of all."""
        return {way: msgspec.structs.replace(each) for way, each in self._ways.items()}
