"""What the master told last about each slave that is not where it belongs, and what they sent."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from devicebus.master.event import Event, SlaveBack, SlaveFailed, SlaveLeft, SlaveLost
from devicebus.master.mailboxes import Unsolicited
from devicebus.master.master import Master
from devicebus.wire.alstatus import name_of, state_name


class Past(NamedTuple):
    """What has happened to a slave since the engine started."""

    losses: int = 0
    """How often it stopped answering."""
    departures: int = 0
    """How often it left its state by itself."""
    al_code: int = 0
    """AL status code when it last did."""


class SlaveFaults:
    """Texts by station address; :meth:`of` returns one, and :meth:`past` what is over.

    Attributes:
        on_unsolicited: Called with each message that a slave sent unasked.
    """

    def __init__(self) -> None:
        self.on_unsolicited: list[Callable[[Unsolicited], None]] = []
        self._texts: dict[int, str] = {}
        self._past: dict[int, Past] = {}

    def of(self, station: int) -> str:
        """Return why a slave is not where it belongs, empty if it is."""
        return self._texts.get(station, "")

    def past(self, station: int) -> Past:
        """Return what has happened to a slave."""
        return self._past.get(station, Past())

    def take_events(self, master: Master) -> None:
        """Take what has happened."""
        while (event := master.next_event()) is not None:
            self._remember(event)
            if isinstance(event, SlaveLost):
                self._texts[event.station] = "it does not answer"
            elif isinstance(event, SlaveFailed):
                self._texts[event.station] = event.reason
            elif isinstance(event, SlaveLeft):
                code = f": AL status code 0x{event.code:04X}, {name_of(event.code)}"
                self._texts[event.station] = (
                    f"it went to {state_name(event.status)} by itself{code if event.code else ''}"
                )
            elif isinstance(event, SlaveBack):
                self._texts.pop(event.station, None)
            elif isinstance(event, Unsolicited):
                for call in self.on_unsolicited:
                    call(event)

    def _remember(self, event: Event) -> None:
        if isinstance(event, SlaveLost):
            past = self.past(event.station)
            self._past[event.station] = past._replace(losses=past.losses + 1)
        elif isinstance(event, SlaveLeft):
            past = self.past(event.station)
            self._past[event.station] = past._replace(
                departures=past.departures + 1, al_code=event.code or past.al_code
            )
