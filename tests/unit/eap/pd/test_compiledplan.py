"""The compiled part of the receive path beside the Python code, which is the reference."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eap.codec.ethercat import EtherCatHeader
from eap.codec.pd import EAP_SM_OFFSET
from eap.compiled import cyclic
from eap.pd import compiledplan
from eap.pd.address import NetIdLearner
from eap.pd.authentication import KeyRing
from eap.pd.spec import Authentication, RxAlternateSpec, RxPdSpec, SentVariableSpec, Substitute
from eap.pd.subscriber import Subscriber
from eap.pd.words import RxWord, StationWord
from tests.support.cyclic import MS, PEER, Receiver, octets, received

pytestmark = pytest.mark.skipif(cyclic is None, reason="needs the compiled part: make setup")

THIRD = "5.99.99.99.1.1"
SOURCES = (b"\x0a\x4d\0\1", b"\x0a\x4d\0\2", b"")
VARIABLES = received("a:UINT", "b:UDINT", "c:UDINT", "d:UINT", "e:UINT", "f:BOOL", "g:UINT")
KEYS = KeyRing()


def subscriptions() -> tuple[RxPdSpec, ...]:
    """Subscriptions of every kind: with each, what the compiled part has to leave to Python."""
    timed = {"step": 1, "sender_cycle_us": 1000}
    return (
        RxPdSpec("a", "eap0", 1, ("a",), PEER, timeout_ms=4, **timed),
        RxPdSpec("b", "eap0", 2, ("b",), PEER, **timed, substitute=Substitute.ZERO),
        RxPdSpec("c", "eap0", 2, ("c",), PEER, step=2, sender_cycle_us=500),
        RxPdSpec("d", "eap0", 3, ("d",), PEER, source="10.77.0.1"),
        RxPdSpec("e", "eap0", 4, ("e",), ""),
        RxPdSpec("f", "eap0", 5, ("f",), THIRD, sender_cycle_us=1000),
        RxPdSpec("g", "eap0", 6, ("g",), PEER, auth=Authentication.COUNT, ignore_version=True),
    )


SIZES = {1: 2, 2: 4, 3: 2, 4: 2, 5: 1, 6: 2, 7: 3}


class Twin:
    """One subscriber behind the compiled part, one in Python; both get the same."""

    def __init__(self, *, lenient: bool = False, specs: Sequence[RxPdSpec] | None = None) -> None:
        specs = subscriptions() if specs is None else tuple(specs)
        self.sides = [
            Receiver(*specs, variables=VARIABLES, lenient=lenient, keys=KEYS) for _ in range(2)
        ]
        self.compiled, self.python = self.sides
        assert type(self.compiled.handle) is cyclic.PortHandler
        self.python.handle = self.python.subscriber.receive_frame

    def give(self, frame: bytes, at_ns: int, source: bytes = b"") -> None:
        for side in self.sides:
            side.give(frame, at_ns, source)
        self.compare()

    def compare(self) -> None:
        one, other = (bytes(side.image.memory) for side in self.sides)
        if one != other:
            words = zip(self.compiled.image.words, self.python.image.words, strict=True)
            wrong = {n: pair for n, pair in enumerate(words) if pair[0] != pair[1]}
            pytest.fail(f"the images differ: words {wrong}")


def frame(cycle: int, ids: Sequence[int], publisher: str = PEER, version: int = 0) -> bytes:
    pds = [(n, bytes((cycle + n + k) % 256 for k in range(SIZES[n])), version) for n in ids]
    return octets(pds, cycle=cycle & 0xFFFF, publisher=publisher)


ROUNDS = (1, 1, 1, 1, 1, 0, 2, 3, 31, 33, -1, -2, -40, 0x4000, 0x8000)
WAITS = (1_000_000, 1_000_000, 1_000_000, 999_000, 1_003_500, 2_500_000, 0, -5_000, 200_000_000,
         70_000_000_000)  # fmt: skip
LAYOUTS = ((1,), (2,), (1, 2), (2, 1), (3,), (4,), (5,), (6,), (1, 2, 3, 4, 5, 6), (1, 7), (7,),
           (1, 5), ())  # fmt: skip


USUAL = {
    "round": st.just(1),
    "wait": st.sampled_from((1_000_000, 1_000_500, 2_500_000)),
    "layout": st.sampled_from(((1,), (2,), (1, 2))),
    "publisher": st.just(PEER),
    "source": st.just(SOURCES[0]),
    "version": st.just(0),
    "change": st.just(""),
    "place": st.just(0),
}
UNUSUAL = {
    "round": st.sampled_from(ROUNDS),
    "wait": st.sampled_from(WAITS),
    "layout": st.sampled_from(LAYOUTS),
    "publisher": st.sampled_from((PEER, THIRD)),
    "source": st.sampled_from(SOURCES),
    "version": st.sampled_from((0, 9)),
    "change": st.sampled_from(
        ("sm", "length", "cut", "long", "octet", "open", "close", "resume", "timeout", "swap",
         "forget", "cycle", "inside")
    ),
    "place": st.integers(0, 80),
}  # fmt: skip
usual_step = st.fixed_dictionaries(USUAL)
step = st.one_of(
    usual_step,
    *(st.fixed_dictionaries(USUAL | {what: UNUSUAL[what]}) for what in ("round", "wait", "layout")),
    st.fixed_dictionaries(USUAL | {each: UNUSUAL[each] for each in ("change", "place")}),
    st.fixed_dictionaries(UNUSUAL),
)
"""A frame as all others, or with one thing that is not, or with several."""


class Run:
    """The steps of one example."""

    def __init__(self, *, lenient: bool) -> None:
        self.lenient = lenient
        self.twin = Twin(lenient=lenient)
        self.cycle, self.now_ns = 100, 1_000 * MS

    def take(self, what: dict) -> None:
        self.cycle += what["round"]
        self.now_ns += what["wait"]
        data = frame(self.cycle, what["layout"], what["publisher"], what["version"])
        data = self._changed(data, what["change"], what["place"])
        self._act(what["change"])
        self.twin.give(data, self.now_ns, what["source"])

    def _changed(self, data: bytes, change: str, place: int) -> bytes:
        octets = bytearray(data)
        if change == "sm":
            octets[EAP_SM_OFFSET] = 0x28 | (place & 1) << 5
        if change == "length":
            octets[:2] = EtherCatHeader(place).encode()
        if change == "cut":
            del octets[place:]
        if change == "long":
            octets += bytes(place)
        if change == "octet" and place < len(octets):
            octets[place] ^= 0x11
        return bytes(octets)

    def _act(self, change: str) -> None:
        for side in self.twin.sides:
            subscriber, words = side.subscriber, side.image.words
            match change:
                case "open":
                    subscriber.open(self.now_ns + MS)
                case "close":
                    subscriber.close()
                case "resume":
                    subscriber.resume(self.now_ns)
                case "timeout":
                    subscriber.handle_timeout(self.now_ns)
                case "forget":
                    subscriber._table._forget_plans()
                case "cycle":
                    words[StationWord.CYCLE] += 1
                case "inside":
                    words[StationWord.ENGINE_SEQUENCE] ^= 1
                case "swap":
                    pairs = list(zip(side.spec.subscriptions, side.image.layout.rx, strict=True))
                    after = Subscriber(
                        side.image, pairs, MS, subscriber._table._requests,
                        lenient=self.lenient, keys=KEYS,
                    )  # fmt: skip
                    after.learn_from(subscriber)
                    subscriber.swap_in(after, self.now_ns)
                    after.release()


@given(lenient=st.booleans(), steps=st.lists(step | usual_step, min_size=2, max_size=60))
@settings(max_examples=200)
def test_image_is_the_same_with_and_without_the_compiled_part(lenient, steps):
    run = Run(lenient=lenient)
    for each in steps:
        run.take(each)


@given(data=st.data())
def test_image_is_the_same_for_frames_of_any_bytes(data):
    twin = Twin()
    twin.give(frame(1, (1, 2)), MS, SOURCES[0])
    for number in range(2, 12):
        good = bytearray(frame(number, (1, 2)))
        for place, value in data.draw(
            st.dictionaries(st.integers(0, len(good) - 1), st.integers(0, 255), max_size=3)
        ).items():
            good[place] = value
        twin.give(bytes(good[: data.draw(st.integers(0, len(good)))]), number * MS, SOURCES[0])


def count_fallbacks(receiver: Receiver) -> list[int]:
    """Return a list that grows with each frame that Python takes."""
    calls: list[int] = []
    plain = receiver.subscriber.receive_frame

    def counting(data: memoryview, size: int, at_ns: int, origin: object) -> None:
        calls.append(size)
        plain(data, size, at_ns, origin)

    receiver.subscriber.receive_frame = counting
    receiver.handle = receiver.subscriber.make_handler()
    return calls


def usual(*more: RxPdSpec) -> Receiver:
    pd = RxPdSpec("a", "eap0", 1, ("a",), PEER, step=1, sender_cycle_us=1000)
    return Receiver(pd, *more, variables=VARIABLES)


def test_usual_frames_do_not_reach_python():
    r = usual(RxPdSpec("b", "eap0", 2, ("b",), PEER, step=1, sender_cycle_us=1000))
    calls = count_fallbacks(r)
    for cycle in range(1, 100):
        for ids in ((1, 2), (1, 7)):
            r.give(frame(cycle, ids), cycle * MS, SOURCES[0])
    # The first frame of each layout, and the first layout again: the second parted the trackers.
    assert len(calls) == 3
    assert r.word("a", RxWord.RECEIVED) == 198
    assert r.word("b", RxWord.RECEIVED) == 99


@pytest.mark.parametrize(
    ("cycle", "at_ms", "source"),
    [(12, 12, 0), (9, 11, 0), (0x4010, 11, 0), (11, 70_000, 0), (11, 11, 1)],
    ids=["lost", "reordered", "far ahead", "wrapped", "another source"],
)
def test_unusual_frames_are_left_to_python(cycle, at_ms, source):
    r = usual()
    calls = count_fallbacks(r)
    for n in range(1, 11):
        r.give(frame(n, (1,)), n * MS, SOURCES[0])
    assert len(calls) == 1
    r.give(frame(cycle, (1,)), at_ms * MS, SOURCES[source])
    assert len(calls) == 2


def test_frames_are_left_to_python_while_an_address_is_wanted():
    r = usual()
    learned: list[tuple[bytes, str]] = []
    learner = NetIdLearner(r.subscriber.receive_frame)
    learner.learn = lambda net_id, sender: learned.append((net_id, sender))
    r.handle = r.subscriber.make_handler(learner)
    for n in (1, 2):
        r.give(frame(n, (1,)), n * MS)
    assert not learned
    learner.wanted = {bytes(frame(1, (1,))[2:8])}
    r.give(frame(3, (1,)), 3 * MS)
    assert [sender for _, sender in learned] == ["somebody"]
    assert r.word("a", RxWord.RECEIVED) == 3


def test_plan_that_does_not_fit_its_frame_or_image_is_refused_or_not_used():
    good = next(iter(usual_plan()))
    header, part, counters, watch = good
    cyclic.Plan(24, header, part, counters, watch)
    for wrong in (
        (23, header, part, counters, watch),
        (24, b"", part, counters, watch),
        (24, header[:-1], part, counters, watch),
        (24, header, part[:-8], counters, watch),
        (24, header, part, b"abc", watch),
        (24, header, part, (-1).to_bytes(8, "little", signed=True), watch),
        (24, header, part, (1 << 40).to_bytes(8, "little"), watch),
        (1 << 40, header, part, counters, watch),
        (24, header, changed(part, 0, -1), counters, watch),
        (24, header, changed(part, 7, 1 << 60), counters, watch),
        (24, header, changed(part, 7, -1), counters, watch),
        (24, header, changed(part, 2, -1), counters, watch),
        (24, header, changed(part, 5, 1 << 60), counters, watch),
        (24, header, changed(part, 8, 23), counters, watch),
        (24, header, changed(part, 8, -1), counters, watch),
        (24, header, changed(part, 9, -1), counters, watch),
        (24, header, changed(part, 10, -1), counters, watch),
        (24, header, changed(part, 10, 1 << 62), counters, watch),
    ):
        with pytest.raises(ValueError, match="plan"):
            cyclic.Plan(*wrong)


def usual_plan():
    r = usual()
    r.give(frame(1, (1,)), MS, SOURCES[0])
    ((plan,),) = r.subscriber._table.plans.values()
    assert type(plan.fast) is cyclic.Plan
    (tracker, ((source, target),)) = plan.parts[0]
    part = compiledplan._part(*tracker.timing_numbers, 1)
    part += compiledplan._copy(source.start, target.start, source.stop - source.start)
    yield plan.expected[0], part, b"", plan.watch


def changed(part: bytes, index: int, value: int) -> bytes:
    return part[: 8 * index] + value.to_bytes(8, "little", signed=True) + part[8 * index + 8 :]


@pytest.mark.parametrize("word", [0, 1 << 20])
def test_plan_for_a_larger_image_is_left_to_python(word):
    r = usual()
    calls = count_fallbacks(r)
    r.give(frame(1, (1,)), MS, SOURCES[0])
    ((plan,),) = r.subscriber._table.plans.values()
    ((header, part, counters, _),) = usual_plan()
    target = len(r.image.memory) - 1 if not word else 0
    part = changed(changed(part, 0, word), 9, target)
    plan.fast = cyclic.Plan(24, header, part, counters, plan.watch)
    r.give(frame(2, (1,)), 2 * MS, SOURCES[0])
    assert len(calls) == 2
    assert r.word("a", RxWord.RECEIVED) == 2


def test_released_port_ignores_frames():
    r = usual()
    handler = r.handle
    r.give(frame(1, (1,)), MS)
    r.subscriber.release()
    before = bytes(r.image.memory)
    r.give(frame(2, (1,)), 2 * MS)
    assert bytes(r.image.memory) == before
    handler.detach()


def test_subscriber_is_freed_without_the_collector():
    r = usual()
    r.give(frame(1, (1,)), MS)
    gone = weakref.ref(r.subscriber)
    gc.disable()
    try:
        del r
        assert gone() is None
    finally:
        gc.enable()


def test_handler_in_a_cycle_is_collected():
    r = usual()
    r.give(frame(1, (1,)), MS)
    cycle = [r.handle, r]
    cycle.append(cycle)
    gone = weakref.ref(r.subscriber)
    del r, cycle
    gc.collect()
    assert gone() is None


@pytest.mark.parametrize("wrong", [(), (b"abc", 3, 1), (b"abc", 3, 1 << 80, None), (3, 3, 3, 3)])
def test_handler_raises_for_what_no_driver_gives(wrong):
    with pytest.raises((TypeError, OverflowError, AttributeError)):
        usual().handle(*wrong)


def test_words_that_are_not_aligned_are_refused():
    memory = memoryview(bytearray(4096))
    handler = cyclic.PortHandler(print, None)
    with pytest.raises(ValueError, match="aligned"):
        handler.attach({}, memory, memory[1:4089])
    with pytest.raises(BufferError):
        handler.attach({}, memoryview(bytes(64)), memory)
    with pytest.raises(TypeError):
        handler.attach([], memory, memory)


def test_alternate_layouts_are_the_same_with_and_without_the_compiled_part():
    sent = (SentVariableSpec("a", "UINT"),)
    pd = RxPdSpec(
        "a", "eap0", 1, ("a",), PEER, step=1, sender_cycle_us=1000,
        alternates=(RxAlternateSpec(9, sent),),
    )  # fmt: skip
    twin = Twin(specs=[pd])
    for cycle in range(1, 20):
        twin.give(frame(cycle, (1,), version=9 * (cycle // 5 % 2)), cycle * MS, SOURCES[0])
    assert twin.compiled.word("a", RxWord.RECEIVED) == 19


def test_compiled_part_that_was_built_is_used():
    assert compiledplan._cyclic is cyclic, "an offset or a number of eap/cyclic differs from Python"


def test_offsets_of_another_image_layout_switch_the_compiled_part_off(monkeypatch):
    monkeypatch.setattr(compiledplan, "_cyclic", None)
    r = usual()
    r.give(frame(1, (1,)), MS)
    assert r.handle == r.subscriber.receive_frame
    ((plan,),) = r.subscriber._table.plans.values()
    assert plan.fast is None
