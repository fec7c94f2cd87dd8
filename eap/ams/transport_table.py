"""Packets on their way out: in one piece, or in fragments where a door has not the room."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from eap.ams.action import Forward, Reply
import msgspec

from eap.ams.endpoint import Way
from eap.ams.fragment import iter_fragments
from eap.codec.ams import AmsHeader


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


class Outlet:
    """The doors of a router, seen from inside; raises as :meth:`add`."""

    def __init__(self, doors: Iterable[Door]) -> None:
        self._doors: dict[str, Door] = {}
        self._number = 0
        self._places: dict[Way, str] = {}
        for door in doors:
            self.add(door)

    def add(self, door: Door) -> None:
        """Take one more door.

        Raises:
            ValueError: it has not even room for a fragment, or the name of another.
        """
        if door.name in self._doors:
            raise ValueError(f"two doors {door.name!r}")
        if door.room and door.room <= AmsHeader.SIZE:
            raise ValueError(
                f"door {door.name!r}: {door.room} octets, expected more than {AmsHeader.SIZE}"
            )
        self._doors[door.name] = door

    def remove(self, name: str) -> None:
        """Forget a door; nothing goes back by it any more."""
        del self._doors[name]

    @property
    def doors(self) -> Mapping[str, Door]:
        """All doors by name."""
        return self._doors

    def note_place(self, hop: Way, connection: str) -> None:
        """Know that what comes from *hop*, which has a name, comes by *connection*."""
        self._places[hop] = connection

    def is_from(self, hop: Way, way: Way) -> bool:
        """Say whether what comes by *way* may come from *hop*."""
        if hop == way:
            return True
        if hop.door != way.door:
            return False
        return self._doors[way.door].is_shared or self._places.get(hop) == way.connection

    def reply(self, way: Way, packet: bytes) -> Reply:
        """Return how *packet* goes back by *way*."""
        return Reply(way, self._cut(way.door, packet))

    def forward(self, hop: Way, packet: bytes, ticket: int) -> Forward:
        """Return how *packet* goes on to *hop*."""
        return Forward(hop, self._cut(hop.door, packet), ticket)

    def _cut(self, door: str, packet: bytes) -> tuple[bytes, ...]:
        room = self._doors[door].room
        if not room or len(packet) <= room:
            return (packet,)
        self._number += 1
        return tuple(iter_fragments(packet, self._number, room - AmsHeader.SIZE))
