"""Who gets the Ethernet frames that slaves send: clients that sent some themselves (EoE).

A slave does not say whom a frame is for; a client that talks EoE to it wants all of them, as the
master it stands for would.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import NamedTuple

from eap.aoe.way import Way

LISTENS_NS = 60_000_000_000
"""For how long after its last message a client hears a slave."""
MAX_LISTENERS = 8
"""Of one slave."""


class EoeListener(NamedTuple):
    """A client that talks EoE to a slave."""

    address: int
    """By which it calls the slave."""
    send: Callable[[bytes], None]
    until_ns: int


class EoeListeners:
    """The listeners of all slaves of a bus."""

    def __init__(self) -> None:
        self._of: dict[int, OrderedDict[Way, EoeListener]] = {}

    def note(
        self, station: int, way: Way, address: int, send: Callable[[bytes], None], now_ns: int
    ) -> None:
        """Note that a client talks to a slave; the one that did so least lately makes room."""
        of_slave = self._of.setdefault(station, OrderedDict())
        of_slave[way] = EoeListener(address, send, now_ns + LISTENS_NS)
        of_slave.move_to_end(way)
        if len(of_slave) > MAX_LISTENERS:
            of_slave.popitem(last=False)

    def of(self, station: int, now_ns: int) -> list[EoeListener]:
        """Return who hears a slave now."""
        of_slave = self._of.get(station)
        if of_slave is None:
            return []
        for way in [way for way, each in of_slave.items() if each.until_ns <= now_ns]:
            del of_slave[way]
        return [*of_slave.values()]

    def forget(self, way: Way) -> None:
        """Forget a client whose connection is closed."""
        for of_slave in self._of.values():
            of_slave.pop(way, None)
