"""Quiet cycles of the compiled part beside the Python code, which is the reference."""

from __future__ import annotations

import gc

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from devicebus.errors import FrameLostError
from devicebus.master import quietcycle
from devicebus.master.bus import MasterSettings
from devicebus.master.cycle import Cycle, Participation
from devicebus.master.image import BusImage, plan_image
from devicebus.master.link import LINGER_NS
from devicebus.master.master import Master
from devicebus.master.procedure import Sleep
from devicebus.master.quietcycle import QuietPlan, QuietWord, compile_frame, make_words
from devicebus.wire.datagram import fprd, frmw
from eap.compiled import cyclic
from tests.support.busline import MS, US
from tests.support.examples import examples
from tests.unit.devicebus.master.test_image import shape

pytestmark = pytest.mark.skipif(cyclic is None, reason="needs the compiled part: make setup")

STATIONS = (1, 2, 3)
SHAPES = (shape(1, (8, 8), (16,)), shape(2, (8,), (8,)), shape(3, (), (8,)))
LONG = tuple(shape(station, (8,) * 400, (8,) * 400) for station in STATIONS)


class Side:
    """A master with a cycle that was laid out without slaves, and what it has done."""

    def __init__(self, *, is_compiled: bool, knows_lrw: bool, shapes) -> None:
        self.is_compiled = is_compiled
        self.master = Master(MasterSettings())
        self.bus = self.master._bus
        self.log: list = []
        self.image = BusImage(plan_image(shapes))
        self.bus.image = self.image
        fault = lambda now_ns: self.log.append(("fault", now_ns))  # noqa: E731
        self.cycle = self.bus.cycle = Cycle(self.bus.link, self.image, fault, knows_lrw=knows_lrw)
        self.quiet = 0

    def exchange(self, now_ns: int) -> list[bytes]:
        """Do as an EngineBus does."""
        if self.is_compiled and self.master.is_quiet(now_ns):
            frame = self.master.quiet_frame(now_ns)
            assert frame is not None
            self.quiet += 1
            return [frame]
        self.master.handle_timeout(now_ns)
        self.master.start_cycle(now_ns)
        return self.master.frames_to_send(now_ns)

    def set_looks(self, count: int) -> None:
        boxes = [_Box(number, self.log) for number in range(count)]
        self.master._open_mailboxes = lambda: boxes
        self.master.stats()  # mailboxes open in a procedure, which ends the quiet time as this does

    def ask(self, station: int, now_ns: int) -> None:
        def done(outcome, at_ns):
            lost = isinstance(outcome, FrameLostError)
            self.log.append(("reply", at_ns, str(outcome) if lost else list(outcome)))

        self.bus.link.submit([fprd(station, 0x130, 6)], done)

    def sleep(self, duration_ns: int, now_ns: int) -> None:
        def procedure():
            _, at_ns = yield Sleep(duration_ns)
            self.log.append(("slept", at_ns))
            (reply,), at_ns = yield [fprd(1, 0x130, 6)]
            self.log.append(("read", at_ns, reply.wkc))

        self.master.run(procedure(), now_ns)

    def lock(self, *, on: bool) -> None:
        self.cycle.note_time = (lambda at, now: self.log.append((at, now))) if on else None
        self.cycle.extra = [frmw(1, 0x910, 8)] if on else []


class _Box:
    """A mailbox that is idle."""

    is_busy = False

    def __init__(self, station, log):
        self.station = station
        self._log = log

    def poll(self, now_ns):
        self._log.append(("full", self.station, now_ns))


class Twin:
    """Two sides that get the same."""

    def __init__(self, *, knows_lrw: bool = True, shapes=SHAPES) -> None:
        self.sides = [
            Side(is_compiled=each, knows_lrw=knows_lrw, shapes=shapes) for each in (True, False)
        ]
        self.compiled, self.python = self.sides
        self.now_ns = 1000 * MS
        self.way: list[bytes] = []
        """Frames under way."""
        for station in STATIONS:
            self.each(lambda side, at=station: participate(side, at, Participation.ACTIVE))

    def each(self, action) -> None:
        results = [action(side) for side in self.sides]
        assert results[0] == results[1]

    def exchange(self, outputs: bytes = b"") -> None:
        sent = []
        for side in self.sides:
            side.image.outputs[: len(outputs)] = outputs[: len(side.image.outputs)]
            sent.append(side.exchange(self.now_ns))
        assert sent[0] == sent[1]
        self.way += sent[0]
        self.compare()

    def arrive(self, frame: bytes) -> None:
        for side in self.sides:
            side.master.receive_frame(frame, self.now_ns)
        for side in self.sides:
            side.log += side.master.frames_to_send(self.now_ns)
        self.compare()

    def compare(self) -> None:
        one, other = self.sides
        assert one.log == other.log
        assert bytes(one.image.inputs) == bytes(other.image.inputs)
        assert one.cycle.stats() == other.cycle.stats()
        assert (one.cycle.is_good, one.cycle.is_full) == (other.cycle.is_good, other.cycle.is_full)
        assert one.master.is_waiting == other.master.is_waiting
        self.way = self.way[-8:]

    def compare_link(self) -> None:
        """End the quiet time, and compare what the link has counted."""
        one, other = (side.master.stats().link for side in self.sides)
        assert one == other
        self.each(lambda side: side.bus.link._index)
        self.each(lambda side: side.bus.link._round_trip._variation_ns)


def participate(side: Side, station: int, participation: Participation) -> None:
    side.cycle.set_participation(station, participation)


def back(frame: bytes, wkcs, data: int = 0, changes=()) -> bytes:
    """Return *frame* as slaves send it back: other data, and these working counters in turn."""
    octets = bytearray(frame)
    at, more, number = 2, True, 0
    while more:
        word = octets[at + 6] | octets[at + 7] << 8
        start, end = at + 10, at + 10 + (word & 0x7FF)
        for n in range(start, end):
            octets[n] = octets[n] + data + n & 0xFF if data else octets[n]
        octets[end] = wkcs[number % len(wkcs)]
        at, more, number = end + 2, bool(word & 0x8000), number + 1
    for place, value in changes:
        octets[place % len(octets)] ^= value
    return bytes(octets)


def right(twin: Twin) -> list[int]:
    return [each.bit_length() - 1 for each in twin.python.cycle._allowed] + [1]


@pytest.mark.parametrize("knows_lrw", [True, False])
def test_quiet_cycles_are_those_of_python(knows_lrw):
    twin = Twin(knows_lrw=knows_lrw)
    for number in range(600):
        twin.now_ns += MS
        twin.exchange(bytes((number & 0xFF, 2, 3)))
        twin.now_ns += 50 * US + number
        twin.arrive(back(twin.way.pop(), right(twin), number & 0xFF))
        twin.now_ns -= 50 * US + number
    assert twin.compiled.quiet > 590
    twin.compare_link()
    assert twin.python.cycle.stats().good == 600


def test_quiet_cycle_brings_time_and_full_mailboxes():
    twin = Twin()
    twin.each(lambda side: side.lock(on=True))
    twin.each(lambda side: side.set_looks(3))
    for number in range(1, 100):
        twin.now_ns += MS
        twin.exchange()
        twin.arrive(back(twin.way.pop(), right(twin), number))
    assert twin.compiled.quiet > 90
    assert len([each for each in twin.python.log if each[0] == "full"]) > 5
    assert len([each for each in twin.python.log if isinstance(each[0], int)]) == 99


@pytest.mark.parametrize("wkcs", [(7, 0), (7, 1), (7, 0, 1), (7, 1, 0)])
@pytest.mark.parametrize("is_locked", [True, False])
def test_time_and_mailboxes_count_only_with_a_working_counter(wkcs, is_locked):
    twin = Twin()
    twin.each(lambda side: side.lock(on=is_locked))
    twin.each(lambda side: side.set_looks(4))
    for side in twin.sides:
        side.master._looks_every = 1
    for _ in range(20):
        twin.now_ns += MS
        twin.exchange()
        frame = twin.way.pop()
        twin.arrive(back(frame, wkcs, 0, [(at, 0x08) for at in range(len(frame) - 3, 30, -13)]))
    assert twin.compiled.quiet > 15


@pytest.mark.parametrize("is_locked", [True, False])
def test_damaged_frame_is_judged_as_in_python(is_locked):
    twin = Twin()
    twin.each(lambda side: side.lock(on=is_locked))
    twin.each(lambda side: side.set_looks(2))
    for side in twin.sides:
        side.master._looks_every = 1
    size = 2
    for place in range(200):
        for value in (1, 0x40):
            twin.now_ns += MS
            twin.exchange()
            frame = twin.way.pop()
            size = len(frame)
            if place < size:
                twin.arrive(back(frame, [7, 1], 0, [(place, value)]))
            twin.arrive(back(frame, [7, 1], 5))
    assert 40 < size < 200
    assert twin.compiled.quiet > 300


@pytest.mark.parametrize("trip_ns", [1, 2 * US + 1, 3 * MS, 900 * MS, 3000 * MS])
def test_round_trip_of_quiet_cycles_is_measured_as_in_python(trip_ns):
    twin = Twin()
    for side in twin.sides:
        side.master._errors_ns = side.master._look_ns = 1 << 60  # counters, mailboxes: not due
        side.master._cycles_to_look = 1 << 60
    for _ in range(3):  # lost, so that the first round trip is that of a quiet cycle
        twin.now_ns += 2000 * MS
        twin.exchange()
    for _ in range(2):
        twin.now_ns += 2000 * MS
        twin.each(lambda side: side.master.handle_timeout(twin.now_ns))
    for number in range(20):
        twin.now_ns += 5000 * MS
        twin.exchange()
        frame = twin.way.pop()
        twin.now_ns += trip_ns + number * 7919
        twin.arrive(back(frame, [7]))
        if number % 5 == 0:
            twin.compare_link()
    assert twin.compiled.quiet > 10


def test_several_frames_are_left_to_python():
    twin = Twin(shapes=LONG)
    for number in range(1, 20):
        twin.now_ns += MS
        twin.exchange(bytes([number]) * 1000)
        for _ in range(len(twin.way)):
            twin.arrive(back(twin.way.pop(0), [3], number))
    assert twin.compiled.quiet == 0
    assert twin.python.cycle.stats().good == 19


@pytest.mark.parametrize("cut", range(0, 70, 7))
def test_frame_that_is_cut_off_is_left_to_python(cut):
    twin = Twin()
    twin.each(lambda side: side.lock(on=True))
    for _ in range(3):
        twin.now_ns += MS
        twin.exchange()
        frame = back(twin.way.pop(), right(twin))
        if cut:
            twin.arrive(frame[: len(frame) - cut])
        twin.arrive(frame)
    twin.compare_link()


_WKCS = st.sampled_from([(7, 1), (7, 0), (0,), (4, 1), (8, 1), (6, 1), (3, 3, 1)])
_STEPS = st.one_of(
    st.tuples(st.just("cycle"), st.integers(0, 255), _WKCS),
    st.tuples(st.just("cycle"), st.integers(0, 255), st.just((7, 1))),
    st.tuples(st.just("cycle"), st.integers(0, 255), st.just((7, 1))),
    st.tuples(st.just("send"), st.integers(0, 255)),
    st.tuples(st.just("late"), st.integers(0, 7), _WKCS),
    st.tuples(st.just("twice"), st.integers(0, 7)),
    st.tuples(st.just("changed"), st.integers(0, 99), st.integers(1, 255)),
    st.tuples(st.just("foreign"), st.binary(max_size=90)),
    st.tuples(st.just("ask"), st.integers(1, 3)),
    st.tuples(st.just("sleep"), st.integers(0, 20)),
    st.tuples(st.just("wait"), st.sampled_from([10 * US, MS, 3 * MS, 120 * MS, LINGER_NS])),
    st.tuples(
        st.just("participate"), st.sampled_from(STATIONS), st.sampled_from(list(Participation))
    ),
    st.tuples(st.just("lock"), st.booleans()),
    st.tuples(st.just("looks"), st.integers(0, 16)),
    st.tuples(st.just("counters")),
)


class Script(Twin):
    """Events on both sides, by the names in _STEPS."""

    def cycle(self, outputs, wkcs):
        self.send(outputs)
        self.now_ns += 40 * US
        self.late(-1, wkcs, outputs)

    def send(self, outputs):
        self.now_ns += MS
        self.exchange(bytes((outputs, 1, 2)))

    def late(self, number, wkcs, data=0):
        if self.way:
            self.arrive(back(self.way.pop(number % len(self.way)), wkcs, data))

    def twice(self, number):
        if self.way:
            self.arrive(back(self.way[number % len(self.way)], (7, 1)))

    def changed(self, place, value):
        if self.way:
            self.arrive(back(self.way[-1], (7, 1), 0, [(place, value)]))

    def foreign(self, frame):
        self.arrive(frame)

    def ask(self, station):
        self.each(lambda side: side.ask(station, self.now_ns))

    def sleep(self, cycles):
        self.each(lambda side: side.sleep(cycles * MS, self.now_ns))

    def wait(self, duration_ns):
        self.now_ns += duration_ns

    def participate(self, station, participation):
        self.each(lambda side: participate(side, station, participation))

    def lock(self, on):
        self.each(lambda side: side.lock(on=on))

    def looks(self, count):
        self.each(lambda side: side.set_looks(count))

    def counters(self):
        self.compare_link()


@examples(300)
@example([("cycle", 0, (7, 1)), ("wait", 120 * MS), ("looks", 1), ("cycle", 0, (7, 1))], False)
@example([("cycle", 0, (7, 1)), ("looks", 1), *[("cycle", 0, (7, 1))] * 12], True)
@given(st.lists(_STEPS, max_size=40), st.booleans())
def test_any_sequence_leaves_both_sides_equal(steps, knows_lrw):
    twin = Script(knows_lrw=knows_lrw)
    for what, *more in steps:
        getattr(twin, what)(*more)
    twin.compare()
    twin.compare_link()


def frame_of(words, **changes):
    side = Side(is_compiled=True, knows_lrw=True, shapes=SHAPES)
    plan = QuietPlan([(12, 0, 3)], [(15, 0, 4)], [(19, 7)], (), -1)._replace(**changes)
    image = side.image
    return compile_frame(side.cycle._frames[0], plan, words, image.outputs, image.inputs)


@pytest.mark.parametrize("changes", [
    {"writes": [(19, 0, 3)]}, {"writes": [(12, 1, 3)]}, {"writes": [(-1, 0, 1)]},
    {"writes": [(12, 0, -1)]}, {"writes": [(1 << 62, 1 << 62, 1 << 62)]}, {"writes": [(12, 0)]},
    {"reads": [(15, 0, 1000)]}, {"reads": [(15, 3, 2)]}, {"counters": [(20, 7)]},
    {"counters": [(1,)]}, {"looks": [19]}, {"looks": [-1]}, {"looks": [0] * 33}, {"time_at": 12},
])  # fmt: skip
def test_plan_that_reaches_outside_is_refused(changes):
    assert frame_of(make_words()) is not None
    with pytest.raises(ValueError, match=r"outside|cut off"):
        frame_of(make_words(), **changes)


@pytest.mark.parametrize("octets", [b"", b"\x0c\x10", bytes(14), b"\x0c\x10" + bytes(13)])
def test_frame_that_is_none_is_refused(octets):
    words = make_words()
    with pytest.raises(ValueError, match="the frame of a cycle"):
        cyclic.CycleFrame(octets, words, b"", bytearray(), b"", b"", b"", b"", -1)
    with pytest.raises(ValueError, match="cut off"):
        cyclic.CycleFrame(octets, words[:-1], b"", bytearray(), b"", b"", b"", b"", -1)
    with pytest.raises(TypeError, match="keywords"):
        cyclic.CycleFrame(octets, words, b"", bytearray(), b"", b"", b"", b"", time_at=-1)


@pytest.mark.parametrize(("word", "value"), [
    (QuietWord.INDEX, 3), (QuietWord.UNTIL_NS, MS), (QuietWord.INDEXES, 0),
    (QuietWord.INDEXES, 257), (QuietWord.NEXT_INDEX, 8), (QuietWord.NEXT_INDEX, -1),
])  # fmt: skip
def test_frame_is_not_sent_by_words_that_do_not_allow_it(word, value):
    words = make_words()
    words[QuietWord.UNTIL_NS], words[QuietWord.INDEXES] = 9 * MS, 8
    frame = frame_of(words)
    before = list(words)
    words[word], old = value, words[word]
    assert frame.send(5 * MS) is None
    assert frame.send(-1) is None
    words[word] = old
    assert list(words) == before
    assert frame.send(5 * MS)[3] == 0
    with pytest.raises(OverflowError):
        frame.send(1 << 70)


def test_frame_is_freed_with_its_cycle():
    for _ in range(3):
        frame_of(make_words())
    gc.collect()
    words = make_words()
    frame = frame_of(words)
    with pytest.raises(BufferError):
        words.append(1)
    del frame
    words.append(1)


def test_without_the_compiled_part_no_cycle_is_quiet(monkeypatch):
    monkeypatch.setattr(quietcycle, "cyclic", None)
    twin = Twin()
    for _ in range(5):
        twin.now_ns += MS
        twin.exchange()
        twin.arrive(back(twin.way.pop(), right(twin)))
    assert twin.compiled.quiet == 0
