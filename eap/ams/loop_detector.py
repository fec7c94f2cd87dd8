"""Packets that have no answer and were passed on a short time ago: which of them come again."""

from __future__ import annotations

from collections import OrderedDict

MAX_PASSED = 1024
"""Packets that are remembered; one that runs in a circle comes again long before so many others."""


class LoopDetector:
    """The latest packets, by invoke id and addresses."""

    def __init__(self) -> None:
        self._latest: OrderedDict[tuple[int, bytes], None] = OrderedDict()

    def __contains__(self, packet: tuple[int, bytes]) -> bool:
        return packet in self._latest

    def add(self, invoke_id: int, addresses: bytes) -> None:
        """Remember a packet."""
        self._latest[invoke_id, addresses] = None
        if len(self._latest) > MAX_PASSED:
            self._latest.popitem(last=False)
