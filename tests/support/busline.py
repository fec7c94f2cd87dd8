"""A master's parts against a simulated segment: in memory, on a virtual clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Protocol

from devicebus.mailbox.conversation import drive as run_conversation
from devicebus.mailbox.server import MailboxServer
from devicebus.master.esm import change_state
from devicebus.master.link import Link
from devicebus.master.mailboxes import Mailbox, MailboxArea, configure
from devicebus.master.matching import ExpectedSlave
from devicebus.master.procedure import Procedure, Runner, Sleep, Step, StepReplies, Task
from devicebus.master.ring import RingEnd
from devicebus.master.scan import scan
from devicebus.sim.devices.build import build_segment
from devicebus.sim.segment import POLL_NS, SegmentEnd, SimulatedSegment
from devicebus.sim.spec import BusSpec, ChannelSpec, DeviceKind, SlaveSpec
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import (
    Datagram,
    DatagramReply,
    DatagramRequest,
    encode_frame,
    iter_datagrams,
)
from eap.od.slave_config import SlaveConfig

US = 1_000
MS = 1_000_000
TRIP_NS = 20 * US
"""Travel time of a frame."""


class Core(Protocol):
    """The driven object: a master, or a link with a runner."""

    def frames_to_send(self, now_ns: int) -> list[bytes]: ...
    def receive_frame(self, data: bytes, now_ns: int) -> None: ...
    def next_timeout(self) -> int | None: ...
    def handle_timeout(self, now_ns: int) -> None: ...


class Bench:
    """A link with a runner, as a core."""

    def __init__(self, **options: int) -> None:
        self.link = Link(**options)
        self.runner = Runner(self.link)

    def frames_to_send(self, now_ns):
        return self.link.frames_to_send(now_ns)

    def receive_frame(self, data, now_ns):
        self.link.receive_frame(data, now_ns)

    def next_timeout(self):
        times = (self.link.next_timeout(), self.runner.next_timeout())
        return min((at for at in times if at is not None), default=None)

    def handle_timeout(self, now_ns):
        self.link.handle_timeout(now_ns)
        self.runner.handle_timeout(now_ns)


class Line:
    """The wire between *core* and *segment*.

    Attributes:
        lose_out, lose_back: Say which frames are lost, by their number from 0.
    """

    def __init__(self, core: Core, segment: SimulatedSegment) -> None:
        self.core = core
        self.segment = segment
        self.now_ns = 1_000 * MS
        self.lose_out: Callable[[int], bool] = lambda number: False
        self.lose_back: Callable[[int], bool] = lambda number: False
        self.frames = 0
        self.octets = 0

    def step(self, until_ns: int) -> None:
        """Let frames go round and come back, or else the time pass to what happens next."""
        frames = self.core.frames_to_send(self.now_ns)
        if not frames:
            times = (self.core.next_timeout(), self.now_ns + POLL_NS, until_ns)
            due = [at for at in times if at is not None]
            self.now_ns = max(self.now_ns, min(due))
            self.segment.handle_timeout(self.now_ns)
            self.core.handle_timeout(self.now_ns)
            return
        self.now_ns += TRIP_NS
        for frame in frames:
            number, self.frames = self.frames, self.frames + 1
            self.octets += len(frame)
            octets = bytearray(frame)
            if self.lose_out(number):
                continue
            if self.segment.process_frame(octets, self.now_ns) is not SegmentEnd.PRIMARY:
                continue
            if not self.lose_back(number):
                self.core.receive_frame(bytes(octets), self.now_ns)

    def elapse(self, duration_ns: int) -> None:
        """Run for that long."""
        until_ns = self.now_ns + duration_ns
        while self.now_ns < until_ns:
            self.step(until_ns)

    def elapse_until(self, condition: Callable[[], object], limit_ns: int = 3_000 * MS) -> None:
        """Run until *condition* holds, and a little longer, for what else may follow."""
        until_ns = self.now_ns + limit_ns
        while not condition():
            assert self.now_ns < until_ns, "did not happen in time"
            self.elapse(10 * MS)
        self.elapse(50 * MS)

    def wait(self, task: Task, limit_ns: int = 60_000 * MS):
        """Run until *task* is done; return its result or raise its error."""
        until_ns = self.now_ns + limit_ns
        while not task.is_done:
            assert self.now_ns < until_ns, f"{task.name} does not end"
            self.step(until_ns)
        return task.result()


def run(line: Line, procedure: Procedure):
    """Run one procedure on a line whose core is a :class:`Bench`."""
    return line.wait(line.core.runner.start(procedure, line.now_ns))


def answer(frame: bytes, *, wkc: int = 1, data: bytes | None = None) -> bytes:
    """Return a frame as slaves send it back that put *data* into each datagram."""
    return encode_frame(
        [
            Datagram(header, (data or bytes(there))[: len(there)].ljust(len(there), b"\0"), wkc)
            for header, there, _ in iter_datagrams(frame)
        ]
    )


def accesses_of(frame: bytes) -> list[DatagramRequest]:
    """Datagrams of a frame."""
    return [
        DatagramRequest(header.command, header.adp, header.ado, bytes(data))
        for header, data, _ in iter_datagrams(frame)
    ]


def drive(
    procedure: Procedure, respond: Callable[[DatagramRequest], DatagramReply], now_ns: int = 0
):
    """Run a procedure against *respond* alone; sleeps take as long as they say."""

    def exchange(step: Step) -> StepReplies:
        nonlocal now_ns
        if isinstance(step, Sleep):
            now_ns += step.duration_ns
            return StepReplies((), now_ns)
        now_ns += TRIP_NS
        return StepReplies([respond(access) for access in step], now_ns)

    return run_conversation(procedure, exchange)


def slave(name: str, kind: str = "digital", **options) -> SlaveSpec:
    """A slave with one input *in* and one output *out*, unless told otherwise."""
    if kind == "digital":
        options = {
            "inputs": (ChannelSpec(name="in"),),
            "outputs": (ChannelSpec(name="out"),),
        } | options
    return SlaveSpec(name=name, kind=DeviceKind(kind), **({"product": 7} | options))


def expect(spec: SlaveSpec, **config) -> ExpectedSlave:
    """The slave that a master expects, with its configuration."""
    return ExpectedSlave(
        name=spec.name,
        vendor=spec.vendor,
        product=spec.product,
        alias=spec.alias or None,
        config=SlaveConfig(**config),
    )


def segment(*slaves: SlaveSpec, ring: bool = False) -> SimulatedSegment:
    """A simulated bus of these slaves."""
    return build_segment(BusSpec(bus="test", slaves=slaves, ring=ring))


class SlowServer(MailboxServer):
    """A slave's mailbox that answers after *delay_ns*, with its addresses echoed or not."""

    def __init__(self, server: MailboxServer) -> None:
        super().__init__(server.protocols, server.sizes)
        self.delay_ns = 0
        self.echoes = True
        self.held: list[tuple[int, bytes]] = []

    def receive_message(self, message, now_ns):
        octets = bytearray(message)
        if not self.echoes:
            octets[2:4] = b"\0\0"
        self.held.append((now_ns + self.delay_ns, bytes(octets)))

    def next_message(self, now_ns):
        while self.held and self.held[0][0] <= now_ns:
            super().receive_message(self.held.pop(0)[1], now_ns)
        return super().next_message(now_ns)


def open_mailbox(line: Line, station: int = 1001, *, slow: bool = False) -> Mailbox:
    """Bring a slave of a :class:`Bench` to PREOP and return its mailbox.

    What it sends unsolicited is in the attribute *unsolicited* of the line.
    """
    found = run(line, scan())[station - 1001]
    if slow:
        device = line.segment.slaves[station - 1001].device
        device.mailbox = SlowServer(device.mailbox)
    fixed = found.sii.fixed
    area = MailboxArea(fixed.receive_offset, fixed.receive_size, fixed.send_offset, fixed.send_size)
    run(line, configure(station, area))
    run(line, change_state(station, AlState.PREOP))
    line.unsolicited = []
    return Mailbox(station, area, line.core.runner, line.unsolicited.append)


class Paced(Line):
    """A line whose core, a master, starts a cycle every *period_ns*."""

    next_cycle_ns = 0
    period_ns = MS

    def step(self, until_ns):
        if self.now_ns >= self.next_cycle_ns:
            self.core.start_cycle(self.now_ns)
            self.next_cycle_ns = self.now_ns + self.period_ns
        super().step(min(until_ns, self.next_cycle_ns))

    def events(self):
        """Take all events."""
        return list(iter(self.core.next_event, None))


class RingLine(Paced):
    """Both lines of a ring."""

    def step(self, until_ns):
        if self.now_ns >= self.next_cycle_ns:
            self.core.merge_overdue(self.now_ns)
            self.core.start_cycle(self.now_ns)
            self.next_cycle_ns = self.now_ns + self.period_ns
        frames = self.core.frames_to_send(self.now_ns)
        copies = self.core.take_copies()
        if not frames:
            Line.step(self, min(until_ns, self.next_cycle_ns))
            return
        self.now_ns += TRIP_NS
        for pair in zip(frames, copies, strict=True):
            for end, frame in zip(SegmentEnd, pair, strict=True):
                octets = bytearray(frame)
                out = self.segment.process_frame(octets, self.now_ns, end)
                if out is not None:
                    self.core.receive_frame(bytes(octets), self.now_ns, RingEnd(out))


class Slow(Paced):
    """A line on which each frame takes *trip_ns()*, and none overtakes another."""

    def __init__(self, core: Core, segment: SimulatedSegment, trip_ns: Callable[[], int]) -> None:
        super().__init__(core, segment)
        self.trip_ns = trip_ns
        self._under_way: deque[tuple[int, bytes]] = deque()

    def step(self, until_ns: int) -> None:
        """Send frames, and let the time pass to what happens next."""
        if self.now_ns >= self.next_cycle_ns:
            self.core.start_cycle(self.now_ns)
            self.next_cycle_ns = self.now_ns + self.period_ns
        for frame in self.core.frames_to_send(self.now_ns):
            last_ns = self._under_way[-1][0] if self._under_way else 0
            self._under_way.append((max(last_ns, self.now_ns + self.trip_ns()), frame))
            self.frames += 1
        times = [self.core.next_timeout(), self.next_cycle_ns, until_ns]
        times += [at_ns for at_ns, _ in list(self._under_way)[:1]]
        self.now_ns = max(self.now_ns + 1, min(at for at in times if at is not None))
        self.segment.handle_timeout(self.now_ns)
        while self._under_way and self._under_way[0][0] <= self.now_ns:
            frame = bytearray(self._under_way.popleft()[1])
            if self.segment.process_frame(frame, self.now_ns) is SegmentEnd.PRIMARY:
                self.core.receive_frame(bytes(frame), self.now_ns)
        self.core.handle_timeout(self.now_ns)
