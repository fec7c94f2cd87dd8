"""Slaves and buses as commands use them, with any master.

Two kinds fit :class:`SlaveBus`: ``BusSession`` in bus_session.py is a master of its own,
``RunningBus`` in bus_running.py asks that of a running station.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias, TypeVar

import msgspec

from devicebus.errors import BusError, NoMailboxError
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.findings import History
from devicebus.master.procedure import Procedure
from devicebus.wire.alstatus import AlState
from devicebus.wire.register import AlStatus
from eap.runtime.bus_status import FrameCounts

T = TypeVar("T")
Begin: TypeAlias = Callable[[MailboxSizes], Conversation[T]]


class Slave(msgspec.Struct, frozen=True, kw_only=True):
    """One slave as it was found."""

    station: int
    name: str
    vendor: int
    product: int
    revision: int
    serial: int
    alias: int
    status: AlStatus
    protocols: int | None
    """As in its EEPROM; None where it is not known."""
    parent: int | None
    """Position of the slave that it is wired to; None for the master."""
    ports: tuple[int, ...]
    """Open ports."""
    fault: str = ""
    """Why not all is known of it, or why it is not where it belongs."""
    target: int = 0
    """AL state where the master of a running station keeps it."""
    since_ns: int | None = None
    """How many nanoseconds ago *fault* began, if that is known."""


class SlaveBus(Protocol):
    """A bus with a master."""

    def scan(self) -> Sequence[Slave]:
        """Return all slaves in the order of the line."""

    def find(self, name: str) -> Slave:
        """Return the slave with a station address or a name; raise BusError if that is not one."""

    def require_mailbox(self, slave: Slave) -> None:
        """Learn how long the mailbox of *slave* is, as files need; raise BusError otherwise."""

    def converse(
        self,
        slave: Slave,
        begin: Begin[T],
        name: str,
        meanwhile: Callable[[], None] | None = None,
    ) -> T:
        """Talk to a slave's mailbox until the conversation ends; return its result or raise."""

    def bring(self, slaves: Sequence[Slave], target: AlState) -> None:
        """Bring slaves to a state, or raise."""

    def run(self, procedure: Procedure[T], name: str = "a procedure") -> T:
        """Run a procedure to its end and return its result, or raise what went wrong."""

    def frame_counts(self) -> FrameCounts:
        """Return the counters of the master's frames."""

    def known(self) -> Sequence[Slave]:
        """Return all slaves in the order of the line, without asking those that are known."""

    def history(self) -> History | None:
        """Return when faults were seen; None where there is no record."""

    def forget(self) -> None:
        """Forget faults that are over."""


def choose(slaves: Sequence[Slave], name: str) -> Slave:
    """Return the slave with a station address or a name.

    Raises:
        BusError: there is none, or several have that name.
    """
    if name.isdecimal() or name.lower().startswith("0x"):
        fitting = [slave for slave in slaves if slave.station == _number(name)]
    else:
        fitting = [slave for slave in slaves if slave.name == name]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        stations = ", ".join(str(slave.station) for slave in fitting)
        raise BusError(
            f"{len(fitting)} slaves are called {name!r}: use a station address ({stations})"
        )
    known = ", ".join(f"{slave.station} ({slave.name})" for slave in slaves) or "none"
    raise BusError(f"unknown slave {name!r}; known slaves: {known}")


def no_mailbox(slave: Slave, state: str) -> BusError:
    """Return the error of a slave that cannot be talked to in *state*."""
    return NoMailboxError(
        f"slave {slave.station} ({slave.name}) has no mailbox in {state}: nothing but its state,"
        " its EEPROM and its registers can be reached"
    )


def _number(text: str) -> int:
    try:
        return int(text, 0)
    except ValueError:
        return -1
