"""State of a bus and its slaves, shared by the procedures of the master, and its events."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, TypeAlias

import msgspec

from devicebus.master.clocks import drift_datagram
from devicebus.master.cycle import Cycle, Participation
from devicebus.master.image import BusImage, SlaveProcessData
from devicebus.master.link import CEILING_NS, INDEXES, MAX_PIGGYBACK, RETRIES, Link
from devicebus.master.lock import CycleLock
from devicebus.master.mailboxes import Mailbox, MailboxArea, Unsolicited
from devicebus.master.matching import ExpectedSlave
from devicebus.master.pdo import ProcessDataChannel
from devicebus.master.procedure import Alarm, Runner, Task
from devicebus.master.ring import RING_INDEXES, Ring
from devicebus.master.scan import FIRST_STATION, FoundSlave
from devicebus.wire.alstatus import AlState
from eap.codec.mailbox import MailboxType
from eap.od.slave_config import SlaveConfig


class SlaveLost(msgspec.Struct, frozen=True):
    """A slave does not answer any more."""

    station: int
    at_ns: int


class SlaveLeft(msgspec.Struct, frozen=True):
    """A slave has left its state unrequested; *status* and *code* as in its AL status."""

    station: int
    status: int
    code: int
    at_ns: int


class SlaveBack(msgspec.Struct, frozen=True):
    """A slave is back in its target state; *duration_ns* is the time since it left."""

    station: int
    duration_ns: int
    at_ns: int


class SlaveAbsent(msgspec.Struct, frozen=True):
    """An optional slave was unplugged."""

    station: int
    at_ns: int


class SlaveFailed(msgspec.Struct, frozen=True):
    """A slave could not be brought back to its target state; the master retries."""

    station: int
    reason: str
    at_ns: int


class BusLost(msgspec.Struct, frozen=True):
    """Frames stopped coming back."""

    at_ns: int


class BusBack(msgspec.Struct, frozen=True):
    """Frames come back again."""

    at_ns: int


Event: TypeAlias = (
    SlaveLost | SlaveLeft | SlaveBack | SlaveAbsent | SlaveFailed | BusLost | BusBack | Unsolicited
)


MAX_EVENTS = 1000
"""Limit for queued events; the oldest are dropped."""


class MasterSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of a master."""

    expected: Sequence[ExpectedSlave] = ()
    """Expected slaves in the order of the segment, with their configurations.

    Empty disables the comparison, and slaves keep their defaults.
    """
    first_station: int = FIRST_STATION
    frame_timeout_ns: int = CEILING_NS
    """Limit for the time-out of a frame, which follows the round trip."""
    frame_retries: int = RETRIES
    """Repetitions of a datagram whose frame is overdue."""
    acyclic_octets: int = 1536
    """Budget of acyclic datagrams per cycle."""
    watchdog_ms: int | None = None
    """Process data watchdog of the slaves; None keeps their defaults."""
    clocks: bool = False
    """Set and synchronize distributed clocks, also if no slave is configured for SYNC0."""
    cycle_ns: int = 1_000_000
    """Time between two cycles, for SYNC0 and SYNC1 that follow it."""
    lock: bool = False
    """Lock the master's cycle to the reference clock: see CycleLock."""
    lead_ns: int = 0
    """Time before SYNC0 at which frames pass the reference clock; 0 for the default."""
    epoch_offset_ns: int = 0
    """Offset from the master's time to DC system time (nanoseconds since 2000-01-01)."""
    redundant: bool = False
    """True if a second line leads to the other end of the slaves, which then are a ring."""
    allow_lrw: bool = True
    """False exchanges process data by LWR and LRD even if all slaves support LRW."""


class ChangeCount:
    """Count of the changes on a bus that users see: states, mailboxes, slaves, faults.

    Attributes:
        works: Number of tasks that bring a slave to a state now.
    """

    def __init__(self) -> None:
        self.count = 0
        self.works = 0

    def note(self) -> int:
        """Count a change; return the new count."""
        self.count += 1
        return self.count


# Attributes of a slave whose changes users of the bus see.
_NOTED = frozenset(("state", "target", "is_lost", "is_absent", "mailbox", "work", "found"))
_UNSET = object()


class BusSlave:
    """Slave as the master drives it.

    Attributes:
        revision: Count of changes of the bus at its last change.
        state: AL state at the last read; None after the slave was lost, until the next read.
        target: Requested state.
        expected: The slave that it stands for; None if nothing is expected.
        config: Its configuration.
        is_mapped: True once its process data was read; it is the same after a restart of the slave.
        is_configured: True if its PDOs and start-up writes of PS are done since it entered PREOP.
        is_set_up: True while its sync managers and FMMUs are configured for process data.
        channels: Sync managers of its process data.
        mailbox: Open mailbox; None in states without one.
        missing_since_ns: Time at which it left its target state; None while it is there.
        is_lost: True from a missing answer until the slave is configured again.
        is_absent: True while an optional slave is not plugged in; it is lost then, too.
        work: Task that brings it to a state.
        retry_ns: Earliest time of the next attempt.
    """

    def __init__(
        self,
        found: FoundSlave,
        name: str,
        changes: ChangeCount | None = None,
        expected: ExpectedSlave | None = None,
    ) -> None:
        self._changes = changes or ChangeCount()
        self.revision = 0
        self.found = found
        self.name = name
        self.station = found.station
        self.state: AlState | None = None
        self.target = AlState.INIT
        self.expected = expected
        self.config = expected.config if expected is not None else SlaveConfig()
        self.is_mapped = False
        self.is_configured = False
        self.is_set_up = False
        self.channels: tuple[ProcessDataChannel, ...] = ()
        self.mailbox: Mailbox | None = None
        self.missing_since_ns: int | None = None
        self.is_lost = False
        self.is_absent = False
        self.work: Task[Any] | None = None
        self.retry_ns = 0

    def __setattr__(self, name: str, value: object) -> None:
        """Set an attribute and note the change, so that no procedure can forget to."""
        if name in _NOTED and getattr(self, name, _UNSET) is not value:
            self.note_change()
        super().__setattr__(name, value)

    def note_change(self) -> None:
        """Note a change of this slave."""
        self.revision = self._changes.note()

    def start_work(self, work: Task[Any]) -> None:
        """Note the task that brings the slave to a state, and its end."""
        self.work = work
        self._changes.works += 1
        work.watch(self._end_work)

    def _end_work(self, work: Task[Any]) -> None:
        del work
        self._changes.works -= 1
        self.note_change()

    @property
    def process_data(self) -> SlaveProcessData:
        """Its part of the process image, to plan."""
        return SlaveProcessData(self.station, self.channels, self.found.esc.fmmus)

    @property
    def al_state(self) -> int:
        """AL state to display; 0 while it is unknown or the slave is not yet configured again."""
        return 0 if self.is_lost else int(self.state or 0)

    @property
    def is_busy(self) -> bool:
        """True while a task brings it to a state."""
        return self.work is not None and not self.work.is_done

    @property
    def is_optional(self) -> bool:
        """True if it may be absent."""
        return self.expected is not None and self.expected.is_optional

    def mark_lost(self) -> None:
        """Mark the slave as lost: it does not answer, or another device is in its place."""
        self.is_lost = True
        self.state = None
        self.is_configured = self.is_set_up = False


class BusState:
    """Slaves of a bus, their process data, and the link to them.

    Attributes:
        changes: Count of changes: of slaves, of events and of the list of slaves.
        slaves: By station address, in the order of the segment.
        found: Slaves of the last scan, also if they are not the expected ones.
        image, cycle: None before the process data layout is known.
        reference: Station address of the slave whose clock the others follow.
        is_lost: True while no frame comes back, so that the state of every slave is unknown.
        needs_check: True after a faulty cycle: the watch reads the slaves' states soon.
        alarm: Ends the pause of the watch.
        earliest_check_ns: Time before which it is not to end.
        knows_lrw: True if the cycle uses LRW.
        probe_ns: Time of the next look at slaves that are not expected.
        strangers: Slaves that are plugged in, but not expected, in words.
        lock: Locks the cycle to the reference clock; None if it runs free.
        ring: Merges the frames of both lines; None on a bus with one line.
        cut_ends: Station addresses before and behind the last cut of the ring, None in it for the
            master; None while the place is not known.
    """

    def __init__(self, settings: MasterSettings) -> None:
        self.settings = settings
        self.link = Link(
            ceiling_ns=settings.frame_timeout_ns,
            retries=settings.frame_retries,
            acyclic_octets=settings.acyclic_octets,
            indexes=RING_INDEXES if settings.redundant else INDEXES,
            # A cyclic frame does not wait for a dead line, others do.
            piggyback=0 if settings.redundant else MAX_PIGGYBACK,
        )
        self.lock = _make_lock(settings) if settings.lock else None
        self.ring: Ring | None = None
        if settings.redundant:
            self.ring = Ring(self._handle_ring_change, self._is_expected)
        self.cut_ends: tuple[int | None, int | None] | None = None
        self.runner = Runner(self.link)
        self.changes = ChangeCount()
        self.slaves: dict[int, BusSlave] = {}
        self.found: Sequence[FoundSlave] = ()
        self.image: BusImage | None = None
        self.cycle: Cycle | None = None
        self.reference: int | None = None
        self.is_lost = False
        self.needs_check = False
        self.alarm = Alarm()
        self.earliest_check_ns = 0
        self.knows_lrw = False
        self.strangers: tuple[str, ...] = ()
        self.probe_ns = 0
        self._events: deque[Event] = deque(maxlen=MAX_EVENTS)

    @property
    def uses_clocks(self) -> bool:
        """True if distributed clocks are set and synchronized."""
        return self.settings.clocks or any(
            each.config.sync is not None and each.config.sync.activate >> 8
            for each in self.settings.expected
        )

    def lacks_group(self, slave: BusSlave) -> bool:
        """Return true for an absent slave, of whose hot-connect group others are there."""
        group = slave.config.group
        return (
            slave.is_absent
            and bool(group)
            and any(
                each.config.group == group and not each.is_lost for each in self.slaves.values()
            )
        )

    def emit(self, event: Event) -> None:
        """Queue an event."""
        self._events.append(event)
        # A message of a slave is no change of its state.
        if isinstance(event, Unsolicited):
            return
        if isinstance(event, BusLost | BusBack):
            self.changes.note()
        elif (slave := self.slaves.get(event.station)) is not None:
            slave.note_change()

    def next_event(self) -> Event | None:
        """Return and remove the oldest event."""
        return self._events.popleft() if self._events else None

    def open_mailbox(self, slave: BusSlave, area: MailboxArea) -> None:
        """Open the slave's mailbox."""
        self.close_mailbox(slave)
        slave.mailbox = Mailbox(slave.station, area, self.runner, self.emit, self.forward)

    def forward(
        self, source: int, address: int, kind: MailboxType, data: bytes, now_ns: int
    ) -> bool | None:
        """Forward a message of a slave to the slave with a station address.

        Returns True if it is queued, False if it is dropped, None if no other slave has the
        address.
        """
        target = self.slaves.get(address)
        if target is None or address == source:
            return None
        return target.mailbox is not None and target.mailbox.post(source, kind, data, now_ns)

    def close_mailbox(self, slave: BusSlave) -> None:
        """Close the slave's mailbox; its pending conversations fail."""
        mailbox, slave.mailbox = slave.mailbox, None
        if mailbox is not None:
            mailbox.close()

    def set_participation(self, slave: BusSlave, participation: Participation) -> None:
        """Set the slave's participation in the cycle."""
        if self.cycle is not None:
            self.cycle.set_participation(slave.station, participation)

    def distribute_time(self, reference: int | None) -> None:
        """Distribute this slave's time in every cycle; None stops the distribution."""
        self.reference = reference
        if self.cycle is not None:
            self.cycle.extra = [] if reference is None else [drift_datagram(reference)]
            if self.lock is not None:
                self.cycle.note_time = self.lock.note
        if self.lock is not None and reference is None:
            self.lock.hold()
        self.locate_cut()

    @property
    def beyond_cut(self) -> list[BusSlave]:
        """Slaves that answer and that only the second line reaches; none in a whole ring."""
        ring = self.ring
        if ring is None or ring.is_whole or ring.reached is None:
            return []
        return self._answering[ring.reached :]

    @property
    def _answering(self) -> list[BusSlave]:
        return [slave for slave in self.slaves.values() if not slave.is_lost]

    def check_soon(self, now_ns: int) -> None:
        """Have the watch read the states of the slaves soon."""
        if not self.needs_check:
            self.needs_check = True
            self.alarm.ring(max(now_ns, self.earliest_check_ns))

    def _handle_ring_change(self, now_ns: int) -> None:
        self.check_soon(now_ns)
        self.changes.note()
        self.locate_cut()

    def locate_cut(self) -> None:
        """Find the slaves on both sides of a cut of the ring, and the clock that leads behind it.

        Called when one of these changes: the ring, the slaves, the reference clock.
        """
        ring = self.ring
        # The master itself opens a ring to measure delays.
        if ring is None or ring.is_opened:
            return
        if ring.is_whole is False:
            is_known = ring.reached is not None and self.slaves
            self.cut_ends = self._ends_of_cut(ring.reached or 0) if is_known else None
        clocks = [slave.station for slave in self.beyond_cut if slave.found.esc.has_clock]
        # Without a clock that leads them, those behind the cut would drift apart.
        has_time = self.reference is not None and clocks
        ring.second_reference = clocks[0] if has_time else None

    def _is_expected(self, address: int, wkc: int) -> bool | None:
        return None if self.cycle is None else self.cycle.is_expected(address, wkc)

    def _ends_of_cut(self, reached: int) -> tuple[int | None, int | None]:
        stations = [None, *(slave.station for slave in self._answering), None]
        before, behind = [*stations[reached : reached + 2], None, None][:2]
        return before, behind

    def reset(self) -> None:
        """Reset: all slaves become unknown."""
        for slave in self.slaves.values():
            if slave.work is not None:
                slave.work.cancel()
            self.close_mailbox(slave)
        self.slaves = {}
        self.changes.note()
        self.image = self.cycle = self.reference = None
        # Without cycles nothing refills the budget: acyclic datagrams would stop for ever.
        self.link.stop_cycles()
        self.is_lost = self.needs_check = False
        self.strangers = ()


def _make_lock(settings: MasterSettings) -> CycleLock:
    """Return the lock of a cycle to the reference clock, by the earliest SYNC0 of the slaves."""
    syncs = [each.config.sync for each in settings.expected if each.config.sync is not None]
    signals = [found for each in syncs if (found := each.signals(settings.cycle_ns)) is not None]
    shift_ns = min((each.shift0_ns for each in signals), default=0)
    return CycleLock(settings.cycle_ns, settings.lead_ns, shift_ns)
