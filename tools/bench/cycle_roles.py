"""The product's master in a loop like the engine's: cycles when due, mailboxes in between."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from io import BytesIO
from time import monotonic_ns, thread_time_ns
from typing import Any

from devicebus.mailbox import foe_client
from devicebus.mailbox.coe_client import upload
from devicebus.mailbox.conversation import Conversation, Progress
from devicebus.master.bus import MasterSettings
from devicebus.master.master import Master
from devicebus.master.procedure import Task
from eap.ids import InterfaceUri
from eap.net import realtime
from eap.net.busport import BusPort, open_bus_port
from eap.net.ticker import Ticker
from tools.bench.buses import FILE
from tools.bench.pacing import answer
from tools.bench.timing import Latencies

_FIRST_STATION = 1001
_SETTLE_NS = 500_000_000


def run(job: dict[str, Any]) -> None:
    """Bring all slaves to OP; run for a while without mailbox traffic, then with it."""
    cycle_ns = job["cycle_us"] * 1000
    settings = MasterSettings(
        acyclic_octets=job["acyclic_octets"],
        frame_timeout_ns=job["timeout_ms"] * 1_000_000,
        watchdog_ms=100,
    )
    with (
        closing(open_bus_port(InterfaceUri.parse(f"ethernet://{job['interface']}"))) as port,
        closing(Ticker()) as ticker,
    ):
        loop = Loop(Master(settings), port, ticker, cycle_ns)
        task = loop.master.bring_up(monotonic_ns())
        realtime.prepare(job["priority"], [job["cpu"]])
        loop.run(lambda now_ns: task.is_done)
        task.result()
        loop.run_for(_SETTLE_NS)
        quiet = loop.observe(int(job["seconds"] * 1e9))
        traffic = Traffic(loop.master, bytes(job["size"]))
        loop.run_for(_SETTLE_NS)
        busy = loop.observe(int(job["seconds"] * 1e9))
        counts = {
            "slaves": len(loop.master.slaves),
            "reads": traffic.reads,
            "octets": traffic.octets,
            "errors": traffic.errors,
        }
        answer({"quiet": quiet, "busy": busy, **counts})


class Traffic:
    """A file that goes to the first slave, and an object read from each, again and again."""

    def __init__(self, master: Master, content: bytes) -> None:
        self.reads = 0
        self.errors: list[str] = []
        self.progress = Progress()
        self._octets = 0
        self._master = master
        self._content = content
        for station in master.slaves:
            self._read(station)
        self._write()

    @property
    def octets(self) -> int:
        """Bytes of files that the slave has received."""
        return self._octets + self.progress.done

    def _read(self, station: int) -> None:
        def done(task: Task[bytes]) -> None:
            if self._is_well(task):
                self.reads += 1
                self._read(station)

        self._start(station, upload(0x1018, 1)).watch(done)

    def _write(self) -> None:
        mailbox = self._master.slaves[_FIRST_STATION].mailbox
        assert mailbox is not None  # noqa: S101  all slaves are in OP

        def done(task: Task[int]) -> None:
            self._octets += self.progress.done
            if self._is_well(task):
                self._write()

        self.progress = Progress(len(self._content))
        source = BytesIO(self._content).read
        writing = foe_client.write(FILE, source, mailbox.sizes, progress=self.progress)
        self._start(_FIRST_STATION, writing).watch(done)

    def _is_well(self, task: Task[Any]) -> bool:
        """Record the error of a slave and send it no further request."""
        if task.error is not None:
            self.errors.append(str(task.error))
        return task.error is None

    def _start(self, station: int, conversation: Conversation[Any]) -> Task[Any]:
        return self._master.converse(station, conversation, monotonic_ns())


class Loop:
    """Runs cycles when they are due, as the engine does, and notes how that went."""

    def __init__(self, master: Master, port: BusPort, ticker: Ticker, cycle_ns: int) -> None:
        self.master = master
        self._port = port
        self._ticker = ticker
        self._cycle_ns = cycle_ns
        self._due_ns = monotonic_ns()
        self._index = -1
        self._start_ns = self._worked_ns = 0
        self._begin()
        ticker.register(port.fileno())

    def _begin(self) -> None:
        self._late, self._trips = Latencies(), Latencies()
        self._skipped = self._skipped_by_work = self._unanswered = 0
        self._frames = self._most_frames = 0

    def observe(self, duration_ns: int) -> dict[str, Any]:
        """Run for that long and return what happened meanwhile."""
        self._begin()
        before = self.master.stats().cycle
        began_ns = self._worked_ns = thread_time_ns()
        self._due_ns = monotonic_ns() + self._cycle_ns  # what is above is no part of it
        self.run_for(duration_ns)
        after = self.master.stats().cycle
        assert before is not None  # noqa: S101  process data is laid out
        assert after is not None  # noqa: S101  likewise
        return {
            "cycles": after.cycles - before.cycles,
            "wkc_errors": after.wkc_errors - before.wkc_errors,
            "lost": after.lost - before.lost,
            "skipped": self._skipped,
            "skipped_by_work": self._skipped_by_work,
            "unanswered": self._unanswered,
            "cpu": (thread_time_ns() - began_ns) / duration_ns,
            "late_ns": self._late.summary(),
            "trip_ns": self._trips.summary(),
        }

    def run_for(self, duration_ns: int) -> None:
        """Run for that long."""
        end_ns = monotonic_ns() + duration_ns
        self.run(lambda now_ns: now_ns >= end_ns)

    def run(self, is_over: Callable[[int], bool]) -> None:
        """Run until *is_over*, called once a cycle."""
        master, wait = self.master, self._ticker.wait
        while True:
            timeout_ns = master.next_timeout()
            due_ns = self._due_ns
            wait(due_ns if timeout_ns is None else min(due_ns, timeout_ns))
            self._receive()
            now_ns = monotonic_ns()
            master.handle_timeout(now_ns)
            if now_ns >= due_ns:
                self._cycle(now_ns)
                if is_over(now_ns):
                    return
            for frame in master.frames_to_send(now_ns):
                self._port.send(frame)

    def _cycle(self, now_ns: int) -> None:
        late_ns = now_ns - self._due_ns
        self._late.enter(late_ns)
        skipped = late_ns // self._cycle_ns
        self._due_ns += (1 + skipped) * self._cycle_ns
        taken, self._frames = self._frames, 0
        worked_ns = thread_time_ns()
        if not skipped:
            self._most_frames = max(self._most_frames, taken)
        else:
            self._skipped += skipped
            # A loop that waited for the processor, or did no more than others did in time, was
            # stopped by the machine: a virtual one's clocks of processes go on while it stands.
            has_worked = worked_ns - self._worked_ns >= self._cycle_ns
            if has_worked and taken > self._most_frames:
                self._skipped_by_work += skipped
        self._worked_ns = worked_ns
        self._unanswered += self._index >= 0
        self.master.start_cycle(now_ns)
        frames = self.master.frames_to_send(now_ns)
        for frame in frames:
            self._port.send(frame)
        if frames:
            self._index, self._start_ns = frames[0][3], now_ns  # process data goes first

    def _receive(self) -> None:
        while (frame := self._port.receive()) is not None:
            now_ns = monotonic_ns()
            self._frames += 1
            if frame[3] == self._index:
                self._trips.enter(now_ns - self._start_ns)
                self._index = -1
            self.master.receive_frame(frame, now_ns)
