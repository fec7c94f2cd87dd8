"""Any changes of a layout: each tracker goes on where its subscription does."""

from __future__ import annotations

from collections import Counter

from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from eap.pd.spec import RxPdSpec
from eap.pd.words import RxWord
from tests.support.cyclic import MS, PEER, Receiver, octets, received
from tests.support.examples import examples


class Naive:
    """One PD alone, followed without any of the tricks: the plain rules of the counters."""

    def __init__(self) -> None:
        self.seen: list[int] = []
        self.late: set[int] = set()
        self.counts: Counter[str] = Counter()

    def arrive(self, cycle: int) -> None:
        if not self.seen:
            self.counts["received"] += 1
        elif cycle > self.seen[-1]:
            self.counts["received"] += 1
            self.counts["lost"] += cycle - self.seen[-1] - 1
        elif cycle == self.seen[-1]:
            self.counts["received"] += 1
            self.counts["duplicated"] += 1
            return
        else:
            self.counts["reordered"] += 1
            if cycle not in self.late and cycle > self.seen[0] and cycle not in self.seen:
                self.counts["lost"] -= 1
            self.late.add(cycle)
            return
        self.seen.append(cycle)


NAMES = ("p0", "p1", "p2", "p3")


@examples(60, stateful_step_count=40)
class PartingTrackers(RuleBasedStateMachine):
    """PDs that share a tracker, part and are restarted count as if each had its own."""

    @initialize(first=st.integers(0, 0xFFFF))
    def begin(self, first: int) -> None:
        self.r = Receiver(
            *(
                RxPdSpec(name, "eap0", i, (name,), PEER, sender_cycle_us=1000, step=1)
                for i, name in enumerate(NAMES)
            ),
            variables=received(*(f"{name}:USINT" for name in NAMES)),
        )
        self.models = {name: Naive() for name in NAMES}
        self.data = dict.fromkeys(NAMES, 0)
        self.cycle = first
        self.withheld: list[tuple[int, tuple[int, ...]]] = []

    def deliver(self, cycle: int, pds: tuple[int, ...]) -> None:
        frame = octets([(i, bytes([cycle & 0xFF])) for i in pds], cycle=cycle & 0xFFFF)
        self.r.give(frame, self.cycle * MS)
        for i in pds:
            model = self.models[NAMES[i]]
            before = model.counts["received"]
            model.arrive(cycle)
            if model.counts["received"] > before:
                self.data[NAMES[i]] = cycle & 0xFF

    @rule(pds=st.sets(st.integers(0, 3), min_size=1), dropped=st.integers(0, 3))
    def a_frame_arrives(self, pds: set[int], dropped: int) -> None:
        self.cycle += 1 + dropped
        self.deliver(self.cycle, tuple(sorted(pds)))

    @rule()
    def all_arrive(self) -> None:
        self.cycle += 1
        self.deliver(self.cycle, (0, 1, 2, 3))

    @rule(pds=st.sets(st.integers(0, 3), min_size=1))
    def a_frame_is_doubled(self, pds: set[int]) -> None:
        self.cycle += 1
        self.deliver(self.cycle, tuple(sorted(pds)))
        self.deliver(self.cycle, tuple(sorted(pds)))

    @rule(pds=st.sets(st.integers(0, 3), min_size=1))
    def a_frame_is_overtaken(self, pds: set[int]) -> None:
        self.cycle += 2
        self.deliver(self.cycle, (0, 1, 2, 3))
        self.deliver(self.cycle - 1, tuple(sorted(pds)))

    @rule(cycles=st.integers(1, 200_000))
    def a_cable_is_cut(self, cycles: int) -> None:
        self.cycle += cycles

    @rule()
    def the_engine_is_restarted(self) -> None:
        self.r.start(0)

    @invariant()
    def every_pd_has_its_own_true_counters(self) -> None:
        for name, model in self.models.items():
            for counter in ("received", "lost", "duplicated", "reordered"):
                word = self.r.word(name, RxWord[counter.upper()])
                assert word == model.counts[counter], (name, counter)
            assert self.r.image.read(name) == self.data[name]


TestPartingTrackers = PartingTrackers.TestCase
