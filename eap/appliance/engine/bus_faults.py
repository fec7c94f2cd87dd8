"""Troubles of the slaves of one bus, from the events of its master: those that last or are over."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from devicebus.master.event import (
    BusBack,
    BusLost,
    Event,
    SlaveBack,
    SlaveFailed,
    SlaveLeft,
    SlaveLost,
)
from devicebus.master.findings import NO_ANSWER
from devicebus.master.mailboxes import Unsolicited
from devicebus.master.master import Master
from devicebus.wire.alstatus import name_of, state_name

WHOLE_BUS = 0
"""In place of a station address: no frame comes back."""


class Past(NamedTuple):
    """What has happened to a slave since the engine started."""

    losses: int = 0
    """How often it stopped answering."""
    departures: int = 0
    """How often it left its state by itself."""
    al_code: int = 0
    """AL status code when it last did."""


class Trouble(NamedTuple):
    """Why a slave is not where it belongs, or was not; *until_ns* is None while it lasts."""

    text: str = ""
    since_ns: int = 0
    until_ns: int | None = None


class SlaveFaults:
    """Texts by station address; :meth:`of` returns one, and :meth:`past` what is over.

    Attributes:
        on_unsolicited: Called with each message that a slave sent unasked.
    """

    def __init__(self) -> None:
        self.on_unsolicited: list[Callable[[Unsolicited], None]] = []
        self._troubles: dict[int, Trouble] = {}
        self._past: dict[int, Past] = {}

    def of(self, station: int) -> str:
        """Return why a slave is not where it belongs, empty if it is."""
        trouble = self.last(station)
        return trouble.text if trouble.until_ns is None else ""

    def last(self, station: int) -> Trouble:
        """Return the last trouble of a slave, which may be over."""
        return self._troubles.get(station, Trouble())

    def past(self, station: int) -> Past:
        """Return what has happened to a slave."""
        return self._past.get(station, Past())

    def forget_past(self) -> None:
        """Forget the troubles that are over; what was counted stays."""
        self._troubles = {at: each for at, each in self._troubles.items() if each.until_ns is None}

    def end_all(self, now_ns: int) -> None:
        """End the troubles that last: a master that is replaced reports no end of them."""
        for station, each in self._troubles.items():
            if each.until_ns is None:
                self._end(station, now_ns)

    def take_events(self, master: Master) -> None:
        """Take what has happened."""
        while (event := master.next_event()) is not None:
            self._remember(event)
            if isinstance(event, BusLost):
                self._begin(WHOLE_BUS, "no frame comes back", event.at_ns)
            elif isinstance(event, BusBack):
                self._end(WHOLE_BUS, event.at_ns)
            elif isinstance(event, SlaveLost):
                self._begin(event.station, NO_ANSWER, event.at_ns)
            elif isinstance(event, SlaveFailed):
                self._begin(event.station, event.reason, event.at_ns)
            elif isinstance(event, SlaveLeft):
                code = f": AL status code 0x{event.code:04X}, {name_of(event.code)}"
                text = (
                    f"it went to {state_name(event.status)} by itself{code if event.code else ''}"
                )
                self._begin(event.station, text, event.at_ns)
            elif isinstance(event, SlaveBack):
                self._end(event.station, event.at_ns)
            elif isinstance(event, Unsolicited):
                for call in self.on_unsolicited:
                    call(event)

    def _begin(self, station: int, text: str, at_ns: int) -> None:
        """Note a trouble; one that follows another began with it."""
        before = self.last(station)
        lasts = bool(before.text) and before.until_ns is None
        self._troubles[station] = Trouble(text, before.since_ns if lasts else at_ns)

    def _end(self, station: int, at_ns: int) -> None:
        trouble = self._troubles.get(station)
        if trouble is not None:
            self._troubles[station] = trouble._replace(until_ns=at_ns)

    def _remember(self, event: Event) -> None:
        if isinstance(event, SlaveLost):
            past = self.past(event.station)
            self._past[event.station] = past._replace(losses=past.losses + 1)
        elif isinstance(event, SlaveLeft):
            past = self.past(event.station)
            self._past[event.station] = past._replace(
                departures=past.departures + 1, al_code=event.code or past.al_code
            )
