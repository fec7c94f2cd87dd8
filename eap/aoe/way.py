"""Where packets come from and go to: doors, and the connections and addresses behind them."""

from __future__ import annotations

from typing import NamedTuple

import msgspec


class Way(NamedTuple):
    """A connection, or an address that packets go to without one, of a door.

    Two connections never have the same name while a process runs, even from one address; where
    there are none, *connection* is the sender's address, which answers go back to.
    """

    door: str
    connection: str

    @property
    def kind(self) -> str:
        """Kind of the door, a :class:`~eap.aoe.spec.DoorKind`."""
        return self.door.partition(":")[0]

    def __str__(self) -> str:
        # A door to one address only is named after it, which need not be said twice.
        return f"{self.connection} by {self.door.removesuffix(f':{self.connection}')}"


class Door(msgspec.Struct, frozen=True):
    """What a router has to know of one way to come in and go out.

    Attributes:
        name: As people call it.
        room: Octets of the longest packet in one piece, header included; 0 for any. What is longer
            goes in fragments.
        is_stream: Whether nothing comes twice; elsewhere what is asked again is not passed again.
        is_shared: Whether all answers come by one connection, whoever gives them (a broker).
        is_hub: Whether those behind it reach each other through a router only, so that packets
            may go back to where they came in, though not to the same address.
    """

    name: str
    room: int = 0
    is_stream: bool = False
    is_shared: bool = False
    is_hub: bool = False
