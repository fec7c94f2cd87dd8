"""What a plant file says of a station's routing and access, complete and checked.

Plain values only, as in ``eap.pd.spec``: they cross from the supervisor to services as JSON.
"""

from __future__ import annotations

from enum import StrEnum

import msgspec


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all specifications."""


class AccessService(StrEnum):
    """Kinds of operations that access is granted for."""

    READ = "read"
    """Everything that changes nothing, also notifications and lookups by name."""
    WRITE = "write"
    """Write and ReadWrite, of objects, variables and IDNs."""
    CONTROL = "control"
    """WriteControl, and states written to a master's groups."""
    FILES = "files"
    """FoE opened for write, and what is written to it."""
    RAW = "raw"
    """EtherCAT commands for a bus, VoE, and what cannot be understood."""


class ObjectRange(Record, frozen=True):
    """Objects from *first* to *last*, and of these the subindexes from *low* to *high*."""

    first: int
    last: int
    low: int = 0
    high: int = 0xFF


class AccessTarget(Record, frozen=True):
    """Whoever is behind a NetID, given by its first four, five or all six octets.

    *port* is None for all its AMS ports.
    """

    net_id: str
    port: int | None = None


class AccessRule(Record, frozen=True):
    """What some may do, or may not; of several rules the first that fits counts.

    An empty tuple stands for anything; otherwise one of its items has to fit.

    Attributes:
        name: For logs and people.
        allow: Whether it grants or refuses.
        networks: IPv4 networks that a connection comes from (``10.0.0.0/24``).
        net_ids: Source NetIDs, by their first four, five or all six octets; they prove nothing.
        doors: Doors (``mqtt:line``) or kinds of them (``ams-tcp``, ``udp``, ``tcp``, ``ethernet``,
            ``mqtt``, ``local``).
        targets: What is asked.
        services: What is to be done.
        objects: Of a dictionary; a rule that has some is about nothing else.
    """

    name: str
    allow: bool = True
    networks: tuple[str, ...] = ()
    net_ids: tuple[str, ...] = ()
    doors: tuple[str, ...] = ()
    targets: tuple[AccessTarget, ...] = ()
    services: tuple[AccessService, ...] = ()
    objects: tuple[ObjectRange, ...] = ()
