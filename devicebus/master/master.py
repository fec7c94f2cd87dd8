"""The master: everything together behind the calls of a core."""

from __future__ import annotations

from collections.abc import Hashable
from typing import TypeVar

import msgspec

from devicebus.errors import BusError, MailboxClosedError, NoMailboxError
from devicebus.mailbox.conversation import Conversation
from devicebus.master.bring import bring, standard_mailbox
from devicebus.master.bus import BusSlave, BusState, Event, MasterSettings
from devicebus.master.cycle import Cycle, CycleStats
from devicebus.master.image import BusImage
from devicebus.master.link import LinkStats
from devicebus.master.mailboxes import MailboxStats
from devicebus.master.procedure import Procedure, Task
from devicebus.master.scan import FoundSlave, scan
from devicebus.master.startup import shut_down, start_up
from devicebus.master.watch import (
    ERRORS_PERIOD_NS,
    PortErrorLog,
    poll_error_counters,
    poll_mailboxes,
    watch,
)
from devicebus.wire.alstatus import AlState
from eap.codec.wire import Buffer

T = TypeVar("T")

_WITH_MAILBOX = frozenset((AlState.PREOP, AlState.SAFEOP, AlState.OP))

LOOK_NS = 10_000_000
"""How often idle mailboxes are looked into for unsolicited messages."""


class MasterStats(msgspec.Struct, frozen=True):
    """Counters of all parts; *cycle* once process data is laid out."""

    link: LinkStats
    cycle: CycleStats | None
    mailboxes: dict[int, MailboxStats]


class Master:
    """A type-1 master for one bus.

    The user starts tasks, the driver feeds frames and time, and whoever has the clock of the plant
    calls :meth:`start_cycle`.

    Attributes:
        port_errors: When the error counters of ports have grown.
    """

    def __init__(self, settings: MasterSettings | None = None) -> None:
        self._bus = BusState(settings or MasterSettings())
        self._running: Task[None] | None = None
        self._look_ns = 0
        self._look: Task[None] | None = None
        self.port_errors = PortErrorLog()
        self._errors_ns = 0

    @property
    def slaves(self) -> dict[int, BusSlave]:
        """The slaves by station address, in the order of the line; for reading."""
        return self._bus.slaves

    @property
    def changes(self) -> int:
        """Number of changes so far that matter to users: of states, mailboxes, slaves, faults."""
        return self._bus.changes.count

    @property
    def image(self) -> BusImage | None:
        """Process data, None before it is laid out."""
        return self._bus.image

    @property
    def cycle(self) -> Cycle | None:
        """The exchange of process data, None before it is laid out; for reading."""
        return self._bus.cycle

    @property
    def is_waiting(self) -> bool:
        """Whether frames are under way, so that some may come back."""
        return self._bus.link.is_waiting

    def bring_up(self, now_ns: int, target: AlState = AlState.OP) -> Task[None]:
        """Find the slaves and bring them to *target*; from then on they are kept there.

        What ran before ends.  OP needs cycles: call :meth:`start_cycle` all the while.  Once
        process data is laid out, slaves that fail are tried again and the others are kept.
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
        """Forget the slaves and bring them to INIT, where their outputs are off."""
        self._stop()
        self._running = self.run(shut_down(self._bus), now_ns, "shutting down the bus")
        return self._running

    def scan(self, now_ns: int) -> Task[tuple[FoundSlave, ...]]:
        """Look who is there, without changing anybody's state."""
        return self.run(scan(self._bus.settings.first_station), now_ns, "scanning the bus")

    def request_state(self, station: int, target: AlState, now_ns: int) -> Task[None]:
        """Bring one slave to a state, where it is kept then.

        Raises BusError if there is no such slave, or it is being brought somewhere.
        """
        slave = self._slave(station)
        if slave.is_busy:
            raise BusError(f"slave {station} is on its way to {slave.target.name} already")
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
        """Talk to a slave's mailbox.

        Raises BusError if there is no such slave, or its mailbox is closed.
        """
        slave = self._slave(station)
        if slave.mailbox is None:
            conversation.close()
            raise why_closed(slave)
        return slave.mailbox.converse(conversation, now_ns, name=name, requester=requester)

    def run(self, procedure: Procedure[T], now_ns: int, name: str = "a procedure") -> Task[T]:
        """Run any procedure beside everything else."""
        return self._bus.runner.start(procedure, now_ns, name)

    def start_cycle(self, now_ns: int) -> None:
        """Exchange process data once, and refill the budget of everything else."""
        if self._bus.cycle is not None:
            self._bus.cycle.start(now_ns)

    def stop_cycles(self) -> None:
        """No cycle will be started for now: acyclic frames need not hold back."""
        self._bus.link.stop_cycles()

    def frames_to_send(self, now_ns: int) -> list[bytes]:
        """Take the frames that are ready to go out."""
        return self._bus.link.frames_to_send(now_ns)

    def receive_frame(self, data: Buffer, now_ns: int) -> None:
        """Take a frame that came back."""
        self._bus.link.receive_frame(data, now_ns)

    def next_timeout(self) -> int | None:
        """When :meth:`handle_timeout` must be called."""
        times = [self._bus.link.next_timeout(), self._bus.runner.next_timeout()]
        if self._has_mailbox():
            times.append(self._look_ns)
        return min((at for at in times if at is not None), default=None)

    def handle_timeout(self, now_ns: int) -> None:
        """Time passed; early calls are harmless."""
        self._bus.link.handle_timeout(now_ns)
        self._bus.runner.handle_timeout(now_ns)
        if now_ns >= self._look_ns and self._has_mailbox():
            self._look_ns = now_ns + LOOK_NS
            if self._look is None or self._look.is_done:
                self._look = self.run(poll_mailboxes(self._bus), now_ns, "looking into mailboxes")
        if now_ns >= self._errors_ns and self._bus.cycle is not None:
            self._errors_ns = now_ns + ERRORS_PERIOD_NS
            self.run(
                poll_error_counters(self._bus, self.port_errors), now_ns, "reading error counters"
            )

    def next_event(self) -> Event | None:
        """Take the oldest event."""
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

    def _stop(self) -> None:
        running, self._running = self._running, None
        if running is not None:
            running.cancel()

    def _has_mailbox(self) -> bool:
        return any(slave.mailbox is not None for slave in self._bus.slaves.values())

    @property
    def is_lost(self) -> bool:
        """Whether no frame comes back, so that nothing is known about any slave."""
        return self._bus.is_lost

    def _slave(self, station: int) -> BusSlave:
        try:
            return self._bus.slaves[station]
        except KeyError:
            known = ", ".join(map(str, self._bus.slaves)) or "none"
            raise BusError(f"there is no slave {station}; known are {known}") from None


def why_closed(slave: BusSlave) -> NoMailboxError | MailboxClosedError:
    """Return why a slave has no open mailbox: never, not in its state, or not yet again."""
    who = f"slave {slave.station} ({slave.name})"
    if slave.is_lost:
        return MailboxClosedError(f"{who} does not answer")
    if slave.found.fault or not standard_mailbox(slave.found.sii.fixed).is_there:
        return NoMailboxError(f"{who} has no mailbox: its EEPROM names none")
    if slave.state is None:
        return MailboxClosedError(f"{who} is being identified: its mailbox is not open yet")
    if slave.target in _WITH_MAILBOX:
        return MailboxClosedError(
            f"{who} is in {slave.state.name} and being brought to {slave.target.name}: its mailbox"
            " is closed until PREOP"
        )
    return NoMailboxError(f"{who} has no mailbox in {slave.state.name}")
