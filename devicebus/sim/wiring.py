"""How slaves are wired, and the way a frame takes through them.

A controller hands a frame on from port to port in the order 0, 3, 1, 2 and works on it as it comes
in at port 0; a port without a link loops it back inside.  From this alone follow the order of the
slaves, branches, what a cut cable leaves reachable, and the ring with a second line to the master.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple, TypeAlias

FORWARD_NS = 300
"""From a frame's arrival at one port to its way out of the next."""
CABLE_NS = 50
_NEXT_PORT = {0: 3, 3: 1, 1: 2, 2: 0}

PortAt: TypeAlias = "tuple[int, int]"
"""Number of a slave and one of its ports."""


class Side(IntEnum):
    """An end of the segment at the master; the secondary exists in a ring only."""

    PRIMARY = 0
    SECONDARY = 1


class Way(NamedTuple):
    """What happens to a frame that enters at one side."""

    order: tuple[int, ...]
    """The slaves that work on it."""
    arrivals: dict[PortAt, int]
    """Nanoseconds from its entering to its arrival at each port that it comes through."""
    comes_out: Side
    closed_at: int | None
    """Index in *order* of the first slave that has no link at port 0."""


Links: TypeAlias = Mapping[PortAt, "PortAt | Side"]
"""What each port is joined to; ports without a link are missing."""


def find_way(links: Links, enters: PortAt, cable_ns: int = CABLE_NS) -> Way:
    """Follow a frame from the port where it enters until it leaves the segment."""
    order: list[int] = []
    arrivals: dict[PortAt, int] = {}
    closed_at = None
    slave, port = enters
    time_ns = 0
    is_loop = False
    while True:
        if not is_loop:
            arrivals[slave, port] = time_ns
        if port == 0:
            if is_loop and closed_at is None:
                closed_at = len(order)
            order.append(slave)
        port = _NEXT_PORT[port]
        target = links.get((slave, port))
        if isinstance(target, Side):
            return Way(tuple(order), arrivals, target, closed_at)
        is_loop = target is None
        if target is not None:
            slave, port = target
            time_ns += FORWARD_NS + cable_ns


def dl_status(joined: frozenset[int]) -> int:
    """Return the DL status of a powered controller whose ports *joined* have a link."""
    status = 0x0007
    for port in range(4):
        closed = port not in joined
        status |= (not closed) << 4 + port
        status |= (0x01 if closed else 0x02) << 8 + 2 * port
    return status
