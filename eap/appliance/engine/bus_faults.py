"""What the master told last about each slave that is not where it belongs, and what they sent."""

from __future__ import annotations

from collections.abc import Callable

from devicebus.master.event import SlaveBack, SlaveFailed, SlaveLeft, SlaveLost
from devicebus.master.mailboxes import Unsolicited
from devicebus.master.master import Master
from devicebus.wire.alstatus import name_of, state_name


class SlaveFaults:
    """Texts by station address; :meth:`of` returns one.

    Attributes:
        on_unsolicited: Called with each message that a slave sent unasked.
    """

    def __init__(self) -> None:
        self.on_unsolicited: list[Callable[[Unsolicited], None]] = []
        self._texts: dict[int, str] = {}

    def of(self, station: int) -> str:
        """Return why a slave is not where it belongs, empty if it is."""
        return self._texts.get(station, "")

    def take_events(self, master: Master) -> None:
        """Take what has happened."""
        while (event := master.next_event()) is not None:
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
