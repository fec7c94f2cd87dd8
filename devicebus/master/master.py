"""Master of one bus: its core without I/O, driven by frames and time."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TypeVar

import msgspec

from devicebus.errors import BusError, MailboxClosedError, NoMailboxError
from devicebus.mailbox.conversation import Conversation
from devicebus.master.bring import bring, standard_mailbox
from devicebus.master.bus import BusSlave, BusState, Event, MasterSettings
from devicebus.master.cycle import Cycle, CycleStats
from devicebus.master.image import BusImage
from devicebus.master.link import LinkStats
from devicebus.master.lock import CycleLock
from devicebus.master.mailboxes import Mailbox, MailboxStats
from devicebus.master.procedure import Procedure, Task
from devicebus.master.ring import Ring, RingEnd
from devicebus.master.scan import FoundSlave, scan
from devicebus.master.startup import shut_down, start_up
from devicebus.master.watch import (
    ERRORS_PERIOD_NS,
    PortErrorLog,
    poll_error_counters,
    poll_mailboxes,
    status_read,
    watch,
)
from devicebus.wire.alstatus import WITH_MAILBOX, AlState
from eap.codec.wire import Buffer

T = TypeVar("T")


LOOK_NS = 10_000_000
"""Poll period of idle mailboxes for unsolicited messages."""
_LOOK_WITHOUT_CYCLES_NS = 4 * LOOK_NS
"""Time without a cycle that looks into the mailboxes, after which they are looked at without."""


class MasterStats(msgspec.Struct, frozen=True):
    """Counters of all parts; *cycle* once process data is laid out."""

    link: LinkStats
    cycle: CycleStats | None
    mailboxes: dict[int, MailboxStats]


class Master:
    """Type-1 master for one bus.

    The user starts tasks; the driver feeds frames and time and calls :meth:`start_cycle` in each
    cycle.

    Attributes:
        port_errors: Log of the error counters of all ports.
    """

    def __init__(self, settings: MasterSettings | None = None) -> None:
        self._bus = BusState(settings or MasterSettings())
        self._running: Task[None] | None = None
        self._look_ns = 0
        self._look: Task[None] | None = None
        self._looks_every = max(1, LOOK_NS // self._bus.settings.cycle_ns)
        self._cycles_to_look = self._in_cycle = 0
        self._looked_at: list[Mailbox] = []
        self._look_cycle: Cycle | None = None
        self.port_errors = PortErrorLog()
        self._errors_ns = 0
        self._copies: list[bytes] = []

    @property
    def ring(self) -> Ring | None:
        """Ring, None on a bus with one line; read-only."""
        return self._bus.ring

    @property
    def lock(self) -> CycleLock | None:
        """Lock of the cycle to the reference clock; None if it runs free."""
        return self._bus.lock

    @property
    def reference(self) -> int | None:
        """Station address of the slave whose clock the others follow; None without one."""
        return self._bus.reference

    @property
    def cut_ends(self) -> tuple[int | None, int | None] | None:
        """Stations before and behind the last cut, None in it for the master; None if unknown."""
        return self._bus.cut_ends

    @property
    def slaves(self) -> dict[int, BusSlave]:
        """Slaves by station address in the order of the segment, read-only."""
        return self._bus.slaves

    @property
    def found(self) -> Sequence[FoundSlave]:
        """Slaves of the last scan, also if they are not the expected ones."""
        return self._bus.found

    @property
    def changes(self) -> int:
        """Count of the changes that users see: of states, mailboxes, slaves, faults."""
        return self._bus.changes.count

    @property
    def image(self) -> BusImage | None:
        """Process image, None before its layout is known."""
        return self._bus.image

    @property
    def cycle(self) -> Cycle | None:
        """Cyclic exchange, None before the layout is known; read-only."""
        return self._bus.cycle

    @property
    def strangers(self) -> tuple[str, ...]:
        """Slaves that were plugged in, but are not expected, in words."""
        return self._bus.strangers

    def lacks_group(self, slave: BusSlave) -> bool:
        """Return true for an absent slave, of whose hot-connect group others are there."""
        return self._bus.lacks_group(slave)

    @property
    def is_busy(self) -> bool:
        """True while a slave is brought to a state."""
        return self._bus.changes.works > 0

    @property
    def is_waiting(self) -> bool:
        """True while frames may come back."""
        return self._bus.link.is_waiting

    def bring_up(self, now_ns: int, target: AlState = AlState.OP) -> Task[None]:
        """Find the slaves, bring them to *target* and keep them there.

        The operation before is cancelled.  OP needs cycles: call :meth:`start_cycle` meanwhile.
        Once the layout is known, failed slaves are retried and the others are kept in *target*.
        """
        self._stop()
        task = self._bus.runner.start(start_up(self._bus, target), now_ns, "bringing up the bus")

        def keep(done: Task[None]) -> None:
            if self._running is done and (done.error is None or self._bus.cycle is not None):
                self._running = self.run(watch(self._bus), now_ns, "watching the bus")

        self._running = task
        task.watch(keep)
        return task

    def shut_down(self, now_ns: int) -> Task[None]:
        """Bring all slaves to INIT, where their outputs are off, and forget them."""
        self._stop()
        self._running = self.run(shut_down(self._bus), now_ns, "shutting down the bus")
        return self._running

    def scan(self, now_ns: int) -> Task[tuple[FoundSlave, ...]]:
        """Find and describe the slaves without changing a state."""
        return self.run(scan(self._bus.settings.first_station), now_ns, "scanning the bus")

    def request_state(self, station: int, target: AlState, now_ns: int) -> Task[None]:
        """Bring one slave to a state and keep it there.

        Raises BusError for an unknown slave, or one whose state is being changed.
        """
        slave = self._slave(station)
        if slave.is_absent:
            raise BusError(f"slave {station} ({slave.name}) is absent: plug it in")
        if slave.is_busy:
            raise BusError(f"slave {station} is being brought to {slave.target.name} already")
        slave.target = target
        work = self.run(bring(self._bus, slave, target), now_ns, f"slave {station}: state")
        slave.start_work(work)
        return work

    def converse(
        self,
        station: int,
        conversation: Conversation[T],
        now_ns: int,
        *,
        name: str = "a request",
        requester: Hashable = None,
    ) -> Task[T]:
        """Start a conversation with a slave's mailbox.

        Raises BusError for an unknown slave or a closed mailbox.
        """
        slave = self._slave(station)
        if slave.mailbox is None:
            conversation.close()
            raise why_closed(slave)
        return slave.mailbox.converse(conversation, now_ns, name=name, requester=requester)

    def run(self, procedure: Procedure[T], now_ns: int, name: str = "a procedure") -> Task[T]:
        """Run a procedure concurrently with all others."""
        return self._bus.runner.start(procedure, now_ns, name)

    def start_cycle(self, now_ns: int) -> None:
        """Exchange process data once, and refill the budget of acyclic datagrams."""
        cycle = self._bus.cycle
        if cycle is None:
            return
        looks = self._count_to_look(now_ns)
        if looks:
            self._place_looks(cycle)
            # Those that do not fit have frames of their own.
            if rest := self._looked_at[self._in_cycle :]:
                self._look_into(rest, now_ns)
        cycle.start(now_ns, looks=looks)

    def is_quiet(self, now_ns: int) -> bool:
        """Return whether nothing but the frame of a cycle is to be sent, for quiet_frame()."""
        cycle = self._bus.cycle
        if cycle is None or self._bus.ring is not None:
            return False
        if not self._cycles_to_look and self._in_cycle < len(self._looked_at):
            return False
        if now_ns >= self._look_ns:  # cycles were late, and handle_timeout() looks into mailboxes
            return False
        return cycle.is_quiet(now_ns) or self._begin_quiet(cycle, now_ns)

    def quiet_frame(self, now_ns: int) -> bytes | None:
        """Return the frame of a quiet cycle; None if it must be started as others."""
        cycle = self._bus.cycle
        assert cycle is not None  # noqa: S101  it is quiet
        return cycle.quiet_frame(now_ns, looks=self._count_to_look(now_ns))

    def _begin_quiet(self, cycle: Cycle, now_ns: int) -> bool:
        due_ns = self._bus.runner.next_timeout()
        until_ns = self._errors_ns if due_ns is None else min(due_ns, self._errors_ns)
        if now_ns >= until_ns or self.is_waiting:
            return False
        self._place_looks(cycle)
        return cycle.begin_quiet(until_ns)

    def _count_to_look(self, now_ns: int) -> bool:
        """Count a cycle; return whether it looks into mailboxes."""
        self._cycles_to_look -= 1
        if self._cycles_to_look >= 0:
            return False
        self._cycles_to_look = self._looks_every - 1
        self._look_ns = now_ns + _LOOK_WITHOUT_CYCLES_NS
        return True

    def _place_looks(self, cycle: Cycle) -> None:
        """Have cycles look into the open mailboxes, as many as fit."""
        boxes = self._open_mailboxes()
        if boxes != self._looked_at or cycle is not self._look_cycle:
            self._looked_at, self._look_cycle = boxes, cycle
            self._in_cycle = cycle.set_looks([*map(status_read, boxes)], self._note_full)

    def _note_full(self, number: int, now_ns: int) -> None:
        self._looked_at[number].poll(now_ns)

    def _look_into(self, boxes: Sequence[Mailbox], now_ns: int) -> None:
        """Look into mailboxes beside the cycle, unless an earlier look is under way."""
        if self._look is None or self._look.is_done:
            self._look = self.run(poll_mailboxes(boxes), now_ns, "looking into mailboxes")

    def _open_mailboxes(self) -> list[Mailbox]:
        return [each.mailbox for each in self._bus.slaves.values() if each.mailbox is not None]

    def stop_cycles(self) -> None:
        """End the cyclic operation: acyclic datagrams are sent without a budget."""
        self._bus.link.stop_cycles()

    def frames_to_send(self, now_ns: int) -> list[bytes]:
        """Return the frames to send now, on the first line."""
        frames = self._bus.link.frames_to_send(now_ns)
        if self._bus.ring is not None and frames:
            self._copies += self._bus.ring.copy_frames(frames, now_ns)
        return frames

    def take_copies(self) -> list[bytes]:
        """Return and remove the frames to send on the second line, behind frames_to_send()."""
        copies, self._copies = self._copies, []
        return copies

    def receive_frame(self, data: Buffer, now_ns: int, line: RingEnd = RingEnd.FIRST) -> None:
        """Handle a frame that came back on a line."""
        ring = self._bus.ring
        if ring is None:
            self._bus.link.receive_frame(data, now_ns)
        elif (merged := ring.receive_frame(line, data, now_ns)) is not None:
            self._bus.link.receive_frame(merged, now_ns)

    def merge_overdue(self, now_ns: int) -> None:
        """Handle frames that came back on one line only, while the other is dead."""
        if self._bus.ring is not None:
            for merged in self._bus.ring.handle_timeout(now_ns):
                self._bus.link.receive_frame(merged, now_ns)

    def next_timeout(self) -> int | None:
        """Return the time at which :meth:`handle_timeout` must be called."""
        times = [self._bus.link.next_timeout(), self._bus.runner.next_timeout()]
        if self._bus.ring is not None:
            times.append(self._bus.ring.next_timeout())
        if self._has_mailbox():
            times.append(self._look_ns)
        return min((at for at in times if at is not None), default=None)

    def handle_timeout(self, now_ns: int) -> None:
        """Handle expired timers; early calls have no effect."""
        # Before the time-outs of the link: one half may be the answer to a frame.
        self.merge_overdue(now_ns)
        self._bus.link.handle_timeout(now_ns)
        self._bus.runner.handle_timeout(now_ns)
        if now_ns >= self._look_ns:
            self._look_ns = now_ns + LOOK_NS
            if boxes := self._open_mailboxes():
                self._look_into(boxes, now_ns)
        if now_ns >= self._errors_ns and self._bus.cycle is not None:
            self._errors_ns = now_ns + ERRORS_PERIOD_NS
            self.run(
                poll_error_counters(self._bus, self.port_errors), now_ns, "reading error counters"
            )

    def next_event(self) -> Event | None:
        """Return and remove the oldest event."""
        return self._bus.next_event()

    def stats(self) -> MasterStats:
        """Return a snapshot of all counters."""
        bus = self._bus
        return MasterStats(
            bus.link.stats(),
            bus.cycle.stats() if bus.cycle is not None else None,
            {
                station: slave.mailbox.stats()
                for station, slave in bus.slaves.items()
                if slave.mailbox is not None
            },
        )

    def forget_past(self) -> None:
        """Reset mailbox requests without a reply, late replies, and a mended cut of the ring."""
        for slave in self._bus.slaves.values():
            if slave.mailbox is not None:
                slave.mailbox.forget_unanswered()
        if self._bus.ring is not None:
            self._bus.ring.forget_past()
        if self._bus.lock is not None:
            self._bus.lock.forget_past()

    def _stop(self) -> None:
        running, self._running = self._running, None
        if running is not None:
            running.cancel()

    def _has_mailbox(self) -> bool:
        return any(slave.mailbox is not None for slave in self._bus.slaves.values())

    @property
    def is_lost(self) -> bool:
        """True while no frame comes back, so that the state of every slave is unknown."""
        return self._bus.is_lost

    def _slave(self, station: int) -> BusSlave:
        try:
            return self._bus.slaves[station]
        except KeyError:
            known = ", ".join(map(str, self._bus.slaves)) or "none"
            raise BusError(f"unknown slave {station}; known slaves: {known}") from None


def why_closed(slave: BusSlave) -> NoMailboxError | MailboxClosedError:
    """Return the error of a slave without an open mailbox: permanent, by its state, or for now."""
    name = f"slave {slave.station} ({slave.name})"
    if slave.is_absent:
        return MailboxClosedError(f"{name} is absent")
    if slave.is_lost:
        return MailboxClosedError(f"{name} does not answer")
    if slave.found.fault or not standard_mailbox(slave.found.sii.fixed).is_there:
        return NoMailboxError(f"{name} has no mailbox: its EEPROM names none")
    if slave.state is None:
        return MailboxClosedError(f"{name} is being identified: its mailbox is not open yet")
    if slave.target in WITH_MAILBOX:
        return MailboxClosedError(
            f"{name} is in {slave.state.name} and being brought to {slave.target.name}: its mailbox"
            " is closed until PREOP"
        )
    return NoMailboxError(f"{name} has no mailbox in {slave.state.name}")
