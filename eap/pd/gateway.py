"""What the mailbox gateway of a bus port is told (ETG.8200); times and sizes as their names say."""

from __future__ import annotations

import msgspec


class _Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class GatewayAddress(_Record, frozen=True):
    """Whom a virtual mailbox address stands for: one of the three."""

    address: int
    station: int = 0
    """Station address of a slave on the same bus."""
    net_id: str = ""
    """Of another bus port, with the AMS *port* of a slave there, or 0xFFFF for the master."""
    port: int = 0
    members: tuple[int, ...] = ()
    """Of a group: station addresses, or virtual ones that are no groups."""


class GatewaySpec(_Record, frozen=True):
    """How one gateway behaves."""

    enabled: bool = True
    """Whether it answers before somebody starts it."""
    port: int = 0
    """UDP and TCP port of its own at each address of the station; 0 for none."""
    answer_ms: int = 900
    silent: bool = False
    """Whether it keeps its own errors to itself."""
    full: bool = False
    """Whether objects of slaves in the master's dictionary have all entries there are."""
    padded: bool = False
    """Whether complete access puts entries of an even size at even octets."""
    addresses: tuple[GatewayAddress, ...] = ()
    in_flight: int = 32
    """Requests of one client that wait."""
    rate: int = 0
    """Requests of one client in a second; 0 for any number."""
    clients: int = 256
