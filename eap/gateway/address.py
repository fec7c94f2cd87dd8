"""Meaning of mailbox addresses: the master, a slave, several slaves, or one of another station.

ETG.8200 has station addresses and 0 for the master.  Beside them stand what its implementations
do: bit 15 marks what is for a slave in any case, 0xFFFF is for all of them, and virtual addresses
of the plant file lead to slaves of any station.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

from eap.ids import NetId

MASTER_ADDRESS = 0
ALL_SLAVES = 0xFFFF
VIRTUAL_BIT = 0x8000


class MasterAddress(NamedTuple):
    """The dictionary of the master itself."""


class SlaveAddress(NamedTuple):
    """A slave on the gateway's own bus."""

    station: int
    """Its station address."""


class RemoteAddress(NamedTuple):
    """A slave, or with port 0xFFFF the master, of another bus; reached by AoE."""

    net_id: NetId
    port: int


class GroupAddress(NamedTuple):
    """Several slaves that each answer for themselves."""

    members: tuple[int, ...]
    """Station addresses, or virtual ones."""


Destination: TypeAlias = MasterAddress | SlaveAddress | RemoteAddress | GroupAddress


class AddressMap:
    """What the addresses of a gateway mean.

    Args:
        virtual: Addresses of the plant file.  They go before station addresses, so that a slave
            that was exchanged can be found where tools look for it; 0 and 0xFFFF stay what they
            are.
    """

    def __init__(
        self, virtual: Mapping[int, SlaveAddress | RemoteAddress | GroupAddress] | None = None
    ) -> None:
        self._virtual = dict(virtual or {})

    def resolve(self, address: int, stations: tuple[int, ...]) -> Destination:
        """Return the meaning of *address*; *stations* are the slaves of the bus.

        A station address without a slave is returned as such; the access to it is what fails.
        """
        if address == MASTER_ADDRESS:
            return MasterAddress()
        if address == ALL_SLAVES:
            return GroupAddress(stations)
        found = self._virtual.get(address)
        if found is not None:
            return found
        if address & VIRTUAL_BIT and address not in stations:
            return SlaveAddress(address & ~VIRTUAL_BIT)
        return SlaveAddress(address)
