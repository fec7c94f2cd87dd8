"""The compiled cycle of a station beside the Python code, which is the reference."""

from __future__ import annotations

import contextlib
import gc
import socket
import struct
import sys
import weakref
from collections.abc import Iterator, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eap.compiled import cyclic
from eap.errors import LocalProtocolError
from eap.ids import NetId
from eap.net.mmsg import ReceiveBatch, SendBatch
from eap.pd import compiledplan
from eap.pd.authentication import KeyRing, Keys
from eap.pd.device import DeviceState
from eap.pd.handover import ImageHandover
from eap.pd.image import Inputs
from eap.pd.link import FrameHandler, OutFrame
from eap.pd.publisher import Publisher
from eap.pd.quality import ForwardedQuality
from eap.pd.spec import (
    REQUESTER,
    CounterSource,
    LinkSpec,
    OnChangeSpec,
    RxPdSpec,
    S7Source,
    StationSpec,
    Substitute,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.station import Station
from eap.pd.txframe import Gather, Selection, Trigger, TxPd
from eap.pd.words import RxWord, StationWord
from tests.support.cyclic import (
    MS,
    PEER,
    eap_port,
    give,
    image_of,
    octets,
    received,
    station,
    written,
)

pytestmark = [
    pytest.mark.net,
    pytest.mark.skipif(cyclic is None, reason="needs the compiled part: make setup"),
]

THERE, UNREACHABLE, NOWHERE = "10.0.0.1", "240.0.0.1", "10.0.0.1:0"
"""Destinations: the receiver of a test, ENETUNREACH, EINVAL."""
NET_ID = "5.23.91.23.1.1"
KEYS = Keys({1: b"0123456789abcdef"}, 1)

BATCH = ReceiveBatch()


@contextlib.contextmanager
def python_alone() -> Iterator[None]:
    """Have everything that is built meanwhile do without the compiled part."""
    compiled, compiledplan._cyclic = compiledplan._cyclic, None
    try:
        yield
    finally:
        compiledplan._cyclic = compiled


def pd(name: str, number: int, *variables: str, **trigger: object) -> TxPdSpec:
    return TxPdSpec(name, number, variables, trigger=TriggerSpec(**trigger))


SCHEDULED = (
    TxFrameSpec("f", "eap0", THERE, (pd("p", 1, "x", "flag"), pd("q", 2, "y"))),
    TxFrameSpec("g", "eap0", THERE, (pd("r", 3, "bit", "two", "x", "flag"),), divider=2, modulo=1),
    TxFrameSpec("h", "eap0", THERE, (pd("s", 4, "a", "two", "bit", cycle_us=3000), )),
    TxFrameSpec("i", "eap0", THERE, (pd("t", 5, "copy", "b"), pd("u", 6, "field", "count"))),
)  # fmt: skip
OTHERS = {
    "change": TxFrameSpec("c", "eap0", THERE, (pd("v", 7, "x", on_change=OnChangeSpec(20, 100)),)),
    "event": TxFrameSpec("e", "eap0", THERE, (pd("w", 8, "y", event=True), pd("w2", 9, "x"))),
    "unreachable": TxFrameSpec("n", "eap0", UNREACHABLE, (pd("n1", 10, "x"),)),
    "refused": TxFrameSpec("o", "eap0", NOWHERE, (pd("o1", 11, "y"),)),
    "poll": TxFrameSpec("l", "eap0", REQUESTER, (TxPdSpec("l1", 12, ("x",), poll_request="ask"),)),
    "signed": TxFrameSpec("d", "eap0", THERE, (pd("d1", 13, "y"),), sign=True),
}
VARIABLES = (
    *written("x:UINT", "y:UDINT", "flag:BOOL", "bit:BIT2", "two:BIT8"),
    *received("a:UINT", "b:BOOL", "copy:UINT", "ask.x:UINT", "count:UINT"),
    VariableSpec("field", "UINT", Writer.SERVICES),
)


def spec_of(*others: str, frames: Sequence[TxFrameSpec] = SCHEDULED, eap_sm: bool = False):
    port = eap_port()
    if eap_sm:
        port = type(port)(port.name, port.kind, port.interface, port.net_id, eap_sm=True)
    return station(
        ports=(port,),
        variables=VARIABLES,
        links=(LinkSpec("a", "copy"),),
        sources=(
            S7Source("field", "press", "DB1.DBW0", timeout_ms=50, substitute=Substitute.HOLD),
            CounterSource("count", 3),
        ),
        subscriptions=(
            RxPdSpec("a", "eap0", 1, ("a",), PEER, sender_cycle_us=1000, step=1, timeout_ms=4),
            RxPdSpec("b", "eap0", 2, ("b",), PEER, sender_cycle_us=1000, step=1),
            RxPdSpec("ask", "eap0", 3, ("ask.x",), PEER),
        ),
        frames=(*frames, *(OTHERS[each] for each in others)),
    )


class Line:
    """A channel whose frames go to a socket; what arrived there is read back."""

    minimum_size = 0

    def __init__(self) -> None:
        self._far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._far.bind(("127.0.3.11", 0))
        self._far.setblocking(False)
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.setblocking(False)
        self.sender = SendBatch(self._sock, self._address)
        self.direct = self.make_direct(self.sender)
        self.waiting: list[tuple[bytes, int]] = []
        self.handlers: list[FrameHandler] = []
        self.calls: list[int] = []
        """Times of calls, negative for those of send()."""

    def make_direct(self, sender: SendBatch) -> object:
        return BATCH.compiled_socket(sender._fd, [], self, sender)

    def _address(self, destination: str) -> tuple[bytes, tuple[str, int]]:
        host, port = self._far.getsockname()
        if destination == UNREACHABLE:
            host = UNREACHABLE
        if destination == NOWHERE:
            port = 0
        packed = struct.pack("@H", socket.AF_INET) + struct.pack("!H", port)
        return packed + socket.inet_aton(host) + bytes(8), (host, port)

    def drain(self, now_ns: int) -> int:
        self.calls.append(now_ns)
        frames, self.waiting = self.waiting, []
        for frame, at_ns in frames:
            for handler in self.handlers:
                give(handler, frame, at_ns)
        return len(frames)

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        self.calls.append(-now_ns)
        return self.sender.send(frames)

    @property
    def drained(self) -> list[int]:
        return [each for each in self.calls if each >= 0]

    def link_header(self, destination: str) -> bytes:
        del destination
        return b""

    def exchange_handler(self, old: FrameHandler, new: FrameHandler) -> None:
        self.handlers[:] = [new if each is old else each for each in self.handlers]

    def arrived(self) -> list[bytes]:
        frames = []
        with contextlib.suppress(BlockingIOError):
            while True:
                frames.append(self._far.recv(4096))
        return frames

    def close(self) -> None:
        self._far.close()
        self._sock.close()


class Side:
    """A station that runs by the compiled part or without it."""

    def __init__(self, spec: StationSpec, *, compiled: bool) -> None:
        self.compiled = compiled
        self.line = Line()
        self.wakes = 0
        self.keys = KeyRing(KEYS)
        self.station = self._make(spec)
        with self.mode():
            self.station.connect("eap0", self.line)
        self.line.handlers.append(self.station.handlers["eap0"])
        self.station.start(1000 * MS)

    def mode(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext() if self.compiled else python_alone()

    def _make(self, spec: StationSpec) -> Station:
        self.image = image_of(spec)
        with self.mode():
            made = Station(spec, self.image, self._wake, self.keys)
        assert ("cycle" in vars(made)) == self.compiled
        return made

    def _wake(self) -> None:
        self.wakes += 1

    def replace(self, spec: StationSpec, now_ns: int) -> None:
        before, image = self.station, self.image
        after = self._make(spec)
        handover = ImageHandover(image, self.image)
        handover.carry_words()
        handover.carry_values(before.inputs.memory)
        with self.mode():
            after.prepare_handover(before)
            after.follow(before, now_ns)
            before.release()
        self.station = after

    @property
    def publisher(self) -> Publisher | None:
        return self.station._ports["eap0"].publisher


class Twins:
    """The same station twice; both get the same."""

    def __init__(self, spec: StationSpec) -> None:
        self.sides = [Side(spec, compiled=each) for each in (True, False)]
        self.now_ns = 1000 * MS
        self.number = 0

    def cycle(self, late_ns: int = 0, *behind_ns: int) -> list[bytes]:
        self.now_ns += MS
        for side in self.sides:
            with side.mode():
                side.station.cycle(self.now_ns - late_ns, self.now_ns, *behind_ns)
        return self.compare()

    def compare(self) -> list[bytes]:
        one, other = self.sides
        sent, expected = one.line.arrived(), other.line.arrived()
        assert [each.hex(" ") for each in sent] == [each.hex(" ") for each in expected]
        words = list(zip(one.image.words, other.image.words, strict=True))
        assert {n: pair for n, pair in enumerate(words) if pair[0] != pair[1]} == {}
        assert bytes(one.image.memory) == bytes(other.image.memory)
        assert one.line.sender.errors == other.line.sender.errors
        assert one.wakes == other.wakes
        assert one.line.drained == other.line.drained
        return sent

    def each(self, do: object, *args: object) -> None:
        for side in self.sides:
            with side.mode():
                do(side, *args)

    def close(self) -> None:
        for side in self.sides:
            side.line.close()


@contextlib.contextmanager
def twins(spec: StationSpec) -> Iterator[Twins]:
    made = Twins(spec)
    try:
        yield made
    finally:
        made.close()


def put(side: Side, name: str, value: object) -> None:
    with side.image.writing(Writer.APPLICATION):
        side.image.write(name, value)


def arrive(side: Side, frame: bytes, at_ns: int) -> None:
    side.line.waiting.append((frame, at_ns))


def add(side: Side, word: StationWord, more: int) -> None:
    side.image.words[word] += more


def fill_field(side: Side, at_ns: int) -> None:
    side.image.words[side.image.layout.fields[0].words] = at_ns


def is_direct(side: Side, yes: bool) -> None:
    side.line.direct.may_send = yes


STATES = (DeviceState.SAFEOP, DeviceState.PREOP, DeviceState.OP)
value = st.integers(0, 3)
late_ns = st.sampled_from((0, 0, 900, 2_500_000, -7_000, 300_000_000))
steps = st.one_of(
    st.tuples(st.just("cycle"), late_ns),
    st.tuples(st.just("cycle"), late_ns, late_ns),
    st.tuples(st.just("put"), st.sampled_from(("x", "y", "flag", "bit", "two")), value),
    st.tuples(
        st.just("put"),
        st.sampled_from(("f.FrameCtrl", "g.FrameCtrl", "p.VarCtrl", "q.VarCtrl", "w.VarCtrl")),
        value,
    ),
    st.tuples(st.just("arrive"), st.sampled_from(((1,), (2,), (1, 2), (3,))), value),
    st.tuples(st.just("word"), st.sampled_from((
        StationWord.OVERRUNS, StationWord.SAMPLED_UNTIL, StationWord.WAITERS,
        StationWord.APPLICATION_SEQUENCE, StationWord.SERVICES_SEQUENCE,
    )), st.sampled_from((1, 2, 1000))),
    st.tuples(st.just("field"), st.sampled_from((0, 30 * MS, -MS))),
    st.tuples(st.just("direct"), st.booleans()),
    st.tuples(st.just("go"), st.sampled_from(STATES)),
    st.tuples(st.just("replace"), st.sampled_from(((), ("change",), ("unreachable", "refused")))),
)  # fmt: skip


class Run:
    """The steps of one example."""

    def __init__(self, made: Twins) -> None:
        self.twins = made
        self.frames = 0

    def take(self, step: tuple) -> None:
        what, *args = step
        getattr(self, what)(*args)

    def cycle(self, late_ns: int, *behind_ns: int) -> None:
        self.twins.cycle(late_ns, *behind_ns)

    def put(self, name: str, number: int) -> None:
        if name in self.twins.sides[0].image.slots:
            values = {"flag": bool(number & 1), "two": 85 * number}
            self.twins.each(put, name, values.get(name, number))

    def arrive(self, ids: tuple[int, ...], number: int) -> None:
        self.frames += 1
        data = {1: bytes((1, number)), 2: bytes((number & 1,)), 3: b"\0\0"}
        frame = octets([(n, data[n], 0, number) for n in ids], cycle=self.frames)
        self.twins.each(arrive, frame, self.twins.now_ns + MS)

    def word(self, word: StationWord, more: int) -> None:
        self.twins.each(add, word, more)

    def field(self, ago_ns: int) -> None:
        self.twins.each(fill_field, self.twins.now_ns - ago_ns)

    def direct(self, yes: bool) -> None:
        self.twins.each(is_direct, yes)

    def go(self, state: DeviceState) -> None:
        for side in self.twins.sides:
            with side.mode(), contextlib.suppress(LocalProtocolError):
                side.station.go(state, self.twins.now_ns)

    def replace(self, others: tuple[str, ...]) -> None:
        for side in self.twins.sides:
            side.replace(spec_of(*others), self.twins.now_ns)


@given(
    others=st.sets(st.sampled_from(tuple(OTHERS))),
    eap_sm=st.booleans(),
    steps=st.lists(steps | st.just(("cycle", 0)), min_size=5, max_size=60),
)
@settings(max_examples=150)
def test_station_does_the_same_with_and_without_the_compiled_part(others, eap_sm, steps):
    with twins(spec_of(*sorted(others), eap_sm=eap_sm)) as made:
        run = Run(made)
        for step in steps:
            run.take(step)
            made.compare()


def usual(*frames: TxFrameSpec) -> StationSpec:
    return station(variables=VARIABLES, frames=frames or SCHEDULED[:2])


class CountCalls:
    """Counts the calls of functions in Python while it is entered."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def _note(self, frame, event, argument) -> None:
        del argument
        if event == "call":
            self.calls.append(frame.f_code.co_qualname)

    def __enter__(self) -> list[str]:
        sys.setprofile(self._note)
        return self.calls

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)


def test_frames_that_go_by_their_schedule_run_no_python():
    with twins(usual()) as made:
        made.cycle()
        side = made.sides[0]
        side.station._rarely.clear()
        side.station._attach()
        side.image.words[StationWord.WAITERS] = -1000
        with CountCalls() as calls:
            for now_ns in range(2000 * MS, 2010 * MS, MS):
                side.station.cycle(now_ns, now_ns)
        assert calls == ["CountCalls.__exit__"]
        assert len(side.line.arrived()) == 15


def test_frames_of_a_channel_that_does_more_go_through_it():
    with twins(usual()) as made:
        side = made.sides[0]
        made.cycle()
        assert [each for each in side.line.calls if each < 0] == []
        made.each(is_direct, False)
        made.cycle()
        assert [each for each in side.line.calls if each < 0] == [-made.now_ns]


@given(
    cycle=st.integers(0, 1 << 40),
    age_cycles=st.one_of(st.sampled_from((-3, -1, 0, 1, 9)), st.integers(600, 1 << 40)),
    response_ns=st.sampled_from((0, 99_999, 100_000, 3_000_000, 7_000_000_000)),
    sent=st.sampled_from((0, 1, 0x1234, 0xFFFF)),
    came=st.booleans(),
    field_ns=st.sampled_from((0, 1, 10**9)),
)
def test_quality_is_the_same_with_and_without_the_compiled_part(
    cycle, age_cycles, response_ns, sent, came, field_ns
):
    qualities = []
    for mode in (contextlib.nullcontext, python_alone):
        image = image_of(spec_of())
        words, slot = image.words, image.layout.rx[0]
        first = slot.words
        words[first + RxWord.TRACKER] = image.layout.rx[1].words
        tracker = image.layout.rx[1].words
        words[StationWord.CYCLE], words[StationWord.CYCLE_AT_NS] = cycle, 10**9 + 123_456
        words[tracker + RxWord.RECEIVED] = came
        words[tracker + RxWord.ARRIVED_IN_CYCLE] = cycle - age_cycles
        words[first + RxWord.RESPONSE_NS] = response_ns
        words[image.layout.fields[0].words] = field_ns
        struct.pack_into("<H", image.memory, slot.offset + 6, sent)
        with mode():
            gather = Gather(image, Inputs(image), ["a"])
            for origins in ((slot,), (image.layout.fields[0],), (image.layout.fields[0], slot)):
                placed = TxPd(
                    image.layout.tx[0], Trigger(TriggerSpec(), None), gather,
                    ForwardedQuality(image, origins),
                )  # fmt: skip
                out = OutFrame(bytearray(60), 0, THERE)
                Selection(out, (placed,)).patch(7)
                qualities.append(bytes(out.buffer))
    assert qualities[:3] == qualities[3:]


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("wrong", [UNREACHABLE, NOWHERE])
def test_frames_behind_one_that_the_kernel_refuses_are_sent(count, wrong):
    frames = [
        TxFrameSpec(f"f{n}", "eap0", wrong if n == count // 2 else THERE, (pd(f"p{n}", n, "x"),))
        for n in range(count)
    ]
    with twins(usual(*frames)) as made:
        for _ in range(3):
            assert len(made.cycle()) == count - 1
        (name,) = made.sides[0].line.sender.errors.items()
        assert name == ("ENETUNREACH" if wrong is UNREACHABLE else "EINVAL", 3)


def test_frames_for_which_there_is_no_room_count_as_skipped():
    with twins(usual()) as made:
        for side in made.sides:
            pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
            for each in pair:
                each.setblocking(False)
            side.line.sender = SendBatch(pair[0])
            side.line.direct = side.line.make_direct(side.line.sender)
            side.line.pair = pair
            side.station._connect_senders()
        for _ in range(1000):
            made.cycle()
        assert made.sides[0].line.sender.errors["EAGAIN"] > 100
        for side in made.sides:
            for each in side.line.pair:
                each.close()
        made.cycle()
        assert made.sides[0].line.sender.errors["EBADF"]


def learn(side: Side, destination: str) -> None:
    side.publisher.learn(NetId.parse(PEER), destination)


def test_plan_follows_another_socket_and_another_destination():
    frame = TxFrameSpec("f", "eap0", NET_ID, (pd("p", 1, "x"),), mac="")
    with twins(usual(frame)) as made:
        assert made.cycle() == []
        for destination in (THERE, UNREACHABLE, THERE):
            made.each(learn, destination)
            assert len(made.cycle()) == (destination == THERE)
        for side in made.sides:
            side.line.close()
            side.line = Line()
            side.station._senders[:] = [(*each[:2], side.line) for each in side.station._senders]
            with side.mode():
                side.station._connect_senders()
        assert len(made.cycle()) == 1


def test_plan_that_does_not_fit_is_refused():
    frame, words = bytearray(20), memoryview(bytearray(8 * 512)).cast("q")
    memories = memoryview(bytearray(64)), memoryview(bytearray(32))

    def moves(*numbers: int) -> bytes:
        return struct.pack("=4q", *numbers)

    def origin(*numbers: int) -> bytes:
        return struct.pack("=3q", *numbers)

    good = [frame, 10, memories, words, MS, moves(1, 0, 96, 64), origin(16, 100, 56)]
    patch = cyclic.Patch(*good)
    for index, wrong in (
        (0, bytearray(11)),
        (1, 19),
        (1, -1),
        (3, words[:50]),
        (4, 0),
        (4, 1 << 62),
        (5, b"abc"),
        (5, moves(2, 0, 96, 64)),
        (5, moves(-1, 0, 96, 64)),
        (5, moves(1, 8 * 32, 96, 8)),
        (5, moves(1, 8 * 31, 96, 16)),
        (5, moves(1, -8, 96, 8)),
        (5, moves(1, 0, 8 * 20, 8)),
        (5, moves(1, 0, 8 * 20 - 1, 2)),
        (5, moves(1, 0, -8, 8)),
        (5, moves(1, 0, 96, -8)),
        (5, moves(1, 0, 96, 1 << 62)),
        (5, moves(1, 1, 96, 9)),
        (6, b"abc"),
        (6, origin(19, 100, 56)),
        (6, origin(-1, 100, 56)),
        (6, origin(16, 100, 57)),
        (6, origin(16, -1, 56)),
        (6, origin(16, 500, 56)),
        (6, origin(16, 512, -1)),
    ):
        with pytest.raises(ValueError, match="patch"):
            cyclic.Patch(*good[:index], wrong, *good[index + 1 :])
    with pytest.raises(BufferError):
        cyclic.Patch(bytes(20), *good[1:])
    row = struct.pack("=4q", 1, 0, 200, 201)
    plan = cyclic.SendPlan(words)
    plan.fill((frame,), (patch,), row)
    for wrong in (
        ((frame,), (), row),
        ((), (), row),
        ((frame,), (print,), row),
        ((frame,), (patch,), row[:-8]),
        ((frame,), (patch,), struct.pack("=4q", 0, 0, 200, 201)),
        ((frame,), (patch,), struct.pack("=4q", 1, 0, 512, 201)),
        ((frame,), (patch,), struct.pack("=4q", 1, 0, 200, -1)),
    ):
        with pytest.raises(ValueError, match="plan"):
            plan.fill(*wrong)
    parts = (None, None, print, print, print, print)
    cycle = cyclic.Cycle(words, 10, parts)
    for wrong in ((words[:50], 10, parts), (words, 0, parts), (words, 10, parts[:-1])):
        with pytest.raises(ValueError, match="cycle"):
            cyclic.Cycle(*wrong)
    for lists in (([], [], [], [], [1]), ([], [], [], [], [(1, 2, 3)]), ([], [], [], [], 7)):
        with pytest.raises((ValueError, TypeError)):
            cycle.attach(*lists)
        cycle.run(1, 1)


@given(
    moves=st.lists(
        st.tuples(st.integers(0, 1), st.integers(0, 120), st.integers(16, 120), st.integers(0, 8)),
        max_size=6,
    )
)
def test_patch_writes_its_bits_and_no_others(moves):
    sources = bytes(range(1, 17)), bytes(range(240, 256))
    words, frame = memoryview(bytearray(8 * 512)).cast("q"), bytearray(b"\xa5" * 16)
    packed = b"".join(struct.pack("=4q", *move) for move in moves)
    cyclic.Patch(frame, 0, sources, words, MS, packed, b"")(0x1234)
    expected = int.from_bytes(b"\x34\x12" + b"\xa5" * 14, "little")
    for memory, source, target, bits in moves:
        mask = (1 << bits) - 1
        value = int.from_bytes(sources[memory], "little") >> source & mask
        expected = expected & ~(mask << target) | value << target
    assert frame == expected.to_bytes(16, "little")


def test_quality_of_words_that_are_no_index_is_the_largest():
    words = memoryview(bytearray(8 * 512)).cast("q")
    memory, frame = memoryview(bytearray(64)), bytearray(20)
    patch = cyclic.Patch(
        frame, 10, (memory, memory), words, MS, b"", struct.pack("=3q", 16, 200, 0)
    )
    for tracker in (-5, 511, 1 << 40, 200):
        words[200] = tracker
        patch(1)
        assert frame[16:18] == b"\xff\xff"


def test_errors_of_steps_are_raised():
    words = memoryview(bytearray(8 * 512)).cast("q")

    def fail(*_: object) -> None:
        raise KeyError("step")

    def no(*_: object) -> bool:
        return False

    def yes(*_: object) -> bool:
        return True

    for place in range(11):
        lists: list = [[], [], [], [], []]
        parts = [no, no, no, no, no, no]
        if place < 5:
            lists[place] = [fail if place < 4 else (1, 2, None, None)]
        else:
            parts[place - 5] = fail
        if place == 8:
            parts[2] = yes
        cycle = cyclic.Cycle(words, 1, tuple(parts))
        cycle.attach(*lists)
        cycle.sends = True
        for _ in range(2):
            words[StationWord.SAMPLED_UNTIL] = words[StationWord.CYCLE] + 1
            words[StationWord.APPLICATION_SEQUENCE] += 2
            with pytest.raises((KeyError, AttributeError)):
                cycle.run(1, 1)
    for wrong in ((), (1,), ("a", 1), (1, "a"), (1 << 70, 1), (1, 1 << 70)):
        with pytest.raises((TypeError, OverflowError)):
            cycle.run(*wrong)


def test_region_of_a_writer_that_stopped_is_looked_at_in_each_cycle():
    with twins(usual()) as made:
        made.each(put, "x", 5)
        made.cycle()
        made.each(add, StationWord.APPLICATION_SEQUENCE, 1)
        for _ in range(3):
            made.cycle()
        assert made.sides[0].image.words[StationWord.TORN] == 3


def test_counter_beyond_32_bits_is_the_same():
    with twins(usual()) as made:
        made.each(add, StationWord.CYCLE, (1 << 33) - 1)
        for _ in range(3):
            made.cycle()


def test_ports_without_subscriptions_are_drained_rarely():
    words = memoryview(bytearray(8 * 512)).cast("q")
    often: list[int] = []
    rarely: list[int] = []
    cycle = cyclic.Cycle(words, 3, (None, None, int, int, int, int))
    cycle.attach([often.append], [rarely.append], [], [], [])
    for now_ns in range(1, 10):
        cycle.run(now_ns, now_ns)
    assert often == list(range(1, 10))
    assert rarely == [3, 6, 9]


def test_steps_do_not_change_and_no_cycle_begins_while_one_runs():
    words = memoryview(bytearray(8 * 512)).cast("q")
    cycle = cyclic.Cycle(words, 1, (None, None, print, print, print, print))
    for step in (lambda _: cycle.attach([], [], [], [], []), lambda now_ns: cycle.run(now_ns, 1)):
        cycle.attach([], [], [step], [], [])
        with pytest.raises(RuntimeError, match="runs"):
            cycle.run(1, 1)


def test_station_is_freed_without_the_collector():
    with twins(usual()) as made:
        made.cycle()
        side = made.sides[0]
        gone = [weakref.ref(side.station), weakref.ref(side.publisher)]
        gc.disable()
        try:
            del side.station
            assert [each() for each in gone] == [None, None]
        finally:
            gc.enable()


def test_cycle_in_a_cycle_is_collected():
    with twins(usual()) as made:
        made.cycle()
        side = made.sides[0]
        side.station._closing.append(lambda now_ns, station=side.station: None)
        side.station._attach()
        gone = weakref.ref(side.station)
        del side.station
        gc.collect()
        assert gone() is None
