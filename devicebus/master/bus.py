"""What the master knows about its bus, shared by the procedures that work on it."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import msgspec

from devicebus.master.clocks import Sync0, drift_datagram
from devicebus.master.cycle import Cycle, Participation
from devicebus.master.image import BusImage
from devicebus.master.link import CEILING_NS, RETRIES, Link
from devicebus.master.mailboxes import Mailbox, Unsolicited
from devicebus.master.mailboxport import MailboxArea
from devicebus.master.pdo import PdoConfiguration, ProcessDataChannel
from devicebus.master.procedure import Runner, Task
from devicebus.master.scan import FIRST_STATION, ExpectedSlave, FoundSlave
from devicebus.wire.alstatus import AlState


class SlaveLost(msgspec.Struct, frozen=True):
    """A slave does not answer any more."""

    station: int
    at_ns: int


class SlaveLeft(msgspec.Struct, frozen=True):
    """A slave has left its state by itself; *status* and *code* as in its AL status."""

    station: int
    status: int
    code: int
    at_ns: int


class SlaveBack(msgspec.Struct, frozen=True):
    """A slave is back in the state where it belongs, so long after it was missed."""

    station: int
    duration_ns: int
    at_ns: int


class SlaveFailed(msgspec.Struct, frozen=True):
    """A slave could not be brought back; it is tried again."""

    station: int
    reason: str
    at_ns: int


class BusLost(msgspec.Struct, frozen=True):
    """No frame comes back."""

    at_ns: int


class BusBack(msgspec.Struct, frozen=True):
    """Frames come back again."""

    at_ns: int


Event: TypeAlias = SlaveLost | SlaveLeft | SlaveBack | SlaveFailed | BusLost | BusBack | Unsolicited


MAX_EVENTS = 1000
"""Events that wait for the user; the oldest are dropped."""


class MasterSettings(msgspec.Struct, frozen=True, kw_only=True):
    """How a master works."""

    expected: Sequence[ExpectedSlave] = ()
    """Slaves in the order of the line; nothing is compared without any."""
    pdo_configurations: Mapping[int, PdoConfiguration] = {}
    """PDOs by station address; other slaves keep what they come with."""
    first_station: int = FIRST_STATION
    frame_timeout_ns: int = CEILING_NS
    """How long a frame may be under way at most; the time-out follows the round trip up to this."""
    frame_retries: int = RETRIES
    """Times that an access is sent again when its frame is overdue."""
    acyclic_octets: int = 1536
    """Budget of acyclic datagrams in a cycle."""
    watchdog_ms: int | None = None
    """After so long without outputs slaves leave OP; None keeps what they come with."""
    clocks: bool = False
    """Whether distributed clocks are set and kept together; SYNC0 needs it."""
    sync0: Mapping[int, Sync0] = {}
    """By station address."""
    epoch_offset_ns: int = 0
    """From the master's time to nanoseconds since 2000-01-01, which the clocks show."""
    allow_lrw: bool = True
    """False exchanges process data by LWR and LRD even where slaves know LRW."""


class ChangeCount:
    """Number of changes on a bus that matter to its users: states, mailboxes, slaves, faults."""

    def __init__(self) -> None:
        self.count = 0

    def note(self) -> int:
        """Count one more; return the number."""
        self.count += 1
        return self.count


_NOTED = frozenset(("state", "target", "is_lost", "mailbox", "work"))
"""Attributes of a unit whose changes matter to users of the bus."""
_UNSET = object()


class BusSlave:
    """One slave that the master drives.

    Attributes:
        revision: Number of its last change among those of the bus.
        state: Its AL state as it was read last; None until it was read since the slave answers.
        target: Where it belongs.
        is_set_up: Whether its sync managers and FMMUs are set for process data.
        channels: Its process data.
        mailbox: Open in the states that have one.
        missing_since_ns: Since when it is not where it belongs; None while it is.
        is_lost: Whether it has not answered and was not set up anew since.
        work: What is going on to bring it somewhere.
        retry_ns: Not tried again before then.
    """

    def __init__(self, found: FoundSlave, name: str, changes: ChangeCount | None = None) -> None:
        self._changes = changes or ChangeCount()
        self.revision = 0
        self.found = found
        self.name = name
        self.station = found.station
        self.state: AlState | None = None
        self.target = AlState.INIT
        self.is_set_up = False
        self.channels: tuple[ProcessDataChannel, ...] = ()
        self.mailbox: Mailbox | None = None
        self.missing_since_ns: int | None = None
        self.is_lost = False
        self.work: Task[Any] | None = None
        self.retry_ns = 0

    def __setattr__(self, name: str, value: object) -> None:
        """Note a change; here, so that no procedure can forget it."""
        if name in _NOTED and getattr(self, name, _UNSET) is not value:
            self.note_change()
        super().__setattr__(name, value)

    def note_change(self) -> None:
        """Note that something about it has changed."""
        self.revision = self._changes.note()

    def start_work(self, work: Task[Any]) -> None:
        """Note that *work* brings it somewhere, and later that this is done."""
        self.work = work
        work.watch(lambda _: self.note_change())

    @property
    def al_state(self) -> int:
        """AL state to be shown, 0 while it is not known or the slave is not set up anew."""
        return 0 if self.is_lost else int(self.state or 0)

    @property
    def is_busy(self) -> bool:
        """Whether it is being brought somewhere."""
        return self.work is not None and not self.work.is_done

    def mark_lost(self) -> None:
        """Forget where it was: it does not answer, or something else is in its place."""
        self.is_lost = True
        self.state = None
        self.is_set_up = False


class BusState:
    """All slaves, their process data, and the wire to them.

    Attributes:
        changes: Noted by units, and here with each event and each new list of units.
        slaves: By station address, in the order of the line.
        image, cycle: None until process data is laid out.
        reference: Station address of the slave whose clock the others follow.
        is_lost: No frame comes back, so that nothing is known about any slave.
        needs_check: The last cycle was not as expected: look at the slaves soon.
    """

    def __init__(self, settings: MasterSettings) -> None:
        self.settings = settings
        self.link = Link(
            ceiling_ns=settings.frame_timeout_ns,
            retries=settings.frame_retries,
            acyclic_octets=settings.acyclic_octets,
        )
        self.runner = Runner(self.link)
        self.changes = ChangeCount()
        self.slaves: dict[int, BusSlave] = {}
        self.image: BusImage | None = None
        self.cycle: Cycle | None = None
        self.reference: int | None = None
        self.is_lost = False
        self.needs_check = False
        self._events: deque[Event] = deque(maxlen=MAX_EVENTS)

    def emit(self, event: Event) -> None:
        """Queue an event for the user."""
        self._events.append(event)
        if isinstance(event, Unsolicited):
            return
        if isinstance(event, BusLost | BusBack):
            self.changes.note()
        elif (slave := self.slaves.get(event.station)) is not None:
            slave.note_change()

    def next_event(self) -> Event | None:
        """Take the oldest event."""
        return self._events.popleft() if self._events else None

    def open_mailbox(self, slave: BusSlave, area: MailboxArea) -> None:
        """The slave's mailbox works from now on."""
        self.close_mailbox(slave)
        slave.mailbox = Mailbox(slave.station, area, self.runner, self.emit)

    def close_mailbox(self, slave: BusSlave) -> None:
        """The slave's mailbox works no longer: whoever waits for it is told."""
        mailbox, slave.mailbox = slave.mailbox, None
        if mailbox is not None:
            mailbox.close()

    def set_participation(self, slave: BusSlave, participation: Participation) -> None:
        """The slave takes part in the cycle, or no longer."""
        if self.cycle is not None:
            self.cycle.set_participation(slave.station, participation)

    def distribute_time(self, reference: int | None) -> None:
        """Hand this slave's time to the others in every cycle, or nobody's."""
        self.reference = reference
        if self.cycle is not None:
            self.cycle.extra = [] if reference is None else [drift_datagram(reference)]

    def reset(self) -> None:
        """Begin anew: no slave is known."""
        for slave in self.slaves.values():
            if slave.work is not None:
                slave.work.cancel()
            self.close_mailbox(slave)
        self.slaves = {}
        self.changes.note()
        self.image = self.cycle = self.reference = None
        self.link.stop_cycles()
        self.is_lost = self.needs_check = False
