"""Invoke ids of requests that are passed on.

AoE has no count of hops.  So that a router knows a request that it has passed on already, the
first router gives each one an id of its own and the next ones keep it.  Such an id is told from
those of clients, who count from 1, by its upper ten bits: they follow from the lower ones and are
never all 0 (own format; to everybody else an invoke id is a number without a meaning).
"""

from __future__ import annotations

from collections.abc import Container

_SERIAL_BITS = 22
_SERIALS = 1 << _SERIAL_BITS
_FACTOR = 2654435761
"""Knuth's multiplier: neighbours get upper bits that have nothing in common."""


class InvokeIds:
    """Gives ids one after the other; one comes again after four millions.

    Args:
        first: Where to begin; another number at each start keeps the answers to what an earlier
            process asked from being taken for those of this one.
    """

    def __init__(self, first: int) -> None:
        self._serial = first % _SERIALS

    def take(self, taken: Container[int]) -> int:
        """Return the next id that is not among *taken*."""
        while True:
            self._serial = serial = (self._serial + 1) % _SERIALS
            invoke_id = _mark(serial) << _SERIAL_BITS | serial
            if invoke_id not in taken:
                return invoke_id


def is_marked(invoke_id: int) -> bool:
    """Say whether a router gave this id."""
    return invoke_id >> _SERIAL_BITS == _mark(invoke_id & _SERIALS - 1)


def _mark(serial: int) -> int:
    return (serial * _FACTOR >> 12 & 0x3FF) or 1
