"""Which slave is wired to which port of which other (ETG.1000.4, DL status).

A frame leaves a slave through its open ports in the order 3, 1, 2 and comes in at port 0, so that
the open ports of all slaves, in the order of the frame, say how the tree looks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from devicebus.wire.register import DlStatus

_ORDER = (3, 1, 2)


class Joint(NamedTuple):
    """How a slave hangs on the bus."""

    ports: tuple[int, ...]
    """Open ports."""
    parent: int | None
    """Position of the slave that it is wired to; None for the master."""
    parent_port: int
    entry_port: int


def open_ports(status: DlStatus) -> tuple[int, ...]:
    """Return the ports with communication whose loop is open."""
    pairs = (
        (status.loop0, status.communication0),
        (status.loop1, status.communication1),
        (status.loop2, status.communication2),
        (status.loop3, status.communication3),
    )
    return tuple(port for port, (loop, alive) in enumerate(pairs) if alive and not loop)


def find_joints(statuses: Sequence[DlStatus]) -> tuple[Joint, ...]:
    """Return where each slave hangs, in the order of positions.

    Open ports that lead nowhere are tolerated: a slave behind them may be gone by now.
    """
    joints: list[Joint] = []
    exits: list[tuple[int, list[int]]] = []  # slaves with ports that no slave was found at yet
    for position, status in enumerate(statuses):
        ports = open_ports(status)
        while exits and not exits[-1][1]:
            exits.pop()
        parent, port = (exits[-1][0], exits[-1][1].pop(0)) if exits else (None, 0)
        entry = 0 if 0 in ports or not ports else ports[0]
        joints.append(Joint(ports, parent, port, entry))
        exits.append((position, [each for each in _ORDER if each in ports and each != entry]))
    return tuple(joints)
