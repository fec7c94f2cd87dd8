"""Two stations on a line with faults."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from eap.codec.pd import iter_pds
from eap.ids import InterfaceUri
from eap.net.loopback import LoopbackChannel, LoopbackLines
from eap.pd.engine import Engine
from eap.pd.image import Image
from eap.pd.report import station_status
from eap.pd.spec import (
    CounterSource,
    OnChangeSpec,
    RxPdSpec,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.station import Station
from tests.support.cyclic import (
    MS,
    PEER,
    eap_port,
    image_of,
    received,
    station,
    written,
)
from tests.support.examples import examples
from tests.support.runstations import (
    assemble,
)

PAIR = {"sender_cycle_us": 1000, "step": 1, "timeout_ms": 50}


def pair(options: str) -> tuple[Engine, Image, Image, LoopbackChannel, list[int]]:
    """A publisher and a subscriber on one line; what the publisher sends suffers *options*.

    The channel is the subscriber's, the list has the counters of all frames as they were handed
    over.
    """
    lines = LoopbackLines()
    sender = station(
        "sender",
        ports=(eap_port("eap0", PEER),),
        variables=(VariableSpec("n", "UDINT", Writer.ENGINE),),
        sources=(CounterSource("n"),),
        frames=(TxFrameSpec("f", "eap0", "10.0.0.1", (TxPdSpec("p", 7, ("n",)),)),),
    )
    handler = station(
        "taker",
        phase_us=500,
        variables=received("n:UDINT"),
        subscriptions=(RxPdSpec("r", "eap0", 7, ("n",), PEER, **PAIR),),
    )
    arrived: list[int] = []
    images, stations = [], []
    for spec, uri in ((sender, f"loop://line{options}"), (handler, "loop://line")):
        channel = lines.open(InterfaceUri.parse(uri))
        image = image_of(spec)
        made = Station(spec, image, lambda: None)
        if spec is handler:
            channel.handlers.append(
                lambda data, size, at_ns, _: arrived.append(int.from_bytes(data[10:12], "little"))
            )
        channel.handlers.append(made.handlers["eap0"])
        made.connect("eap0", channel)
        images.append(image)
        stations.append(made)
    return Engine(stations), images[0], images[1], channel, arrived


@pytest.mark.parametrize(
    "options",
    [
        "",
        "?delay_us=2300",
        "?loss=0.2&seed=1",
        "?duplicate=0.2&seed=2",
        "?reorder=0.2&seed=3",
        "?loss=0.1&duplicate=0.1&reorder=0.1&delay_us=1700&seed=4",
    ],
)
def test_the_counters_of_a_pair_are_what_the_line_did(options):
    engine, sent, taken, _, arrived = pair(options)
    engine.start(0)
    for _ in range(4000):
        engine.handle_timeout(engine.next_timeout())
    row = station_status(taken, 0)["pd"]["rx"][0]
    span = max(arrived) - arrived[0] + 1
    assert row["lost"] == span - len({cycle for cycle in arrived if cycle >= arrived[0]})
    doubled = [cycle for before, cycle in pairwise(arrived) if before == cycle]
    older = sum(cycle < max(arrived[:at]) for at, cycle in enumerate(arrived) if at)
    assert row["reordered"] == older
    assert row["received"] == len(arrived) - older
    if "reorder" not in options:
        assert row["duplicated"] == len(doubled)
    assert bool(row["lost"]) == ("loss" in options)
    assert bool(row["duplicated"]) == ("duplicate" in options)
    assert bool(older) == ("reorder" in options)
    assert taken.read("n") == max(arrived)
    assert station_status(sent, 0)["pd"]["tx"][0]["sent"] == 2000


def test_a_cable_that_is_cut_and_restored_shows_a_gap_of_its_true_length():
    engine, sent, taken, channel, _ = pair("")
    engine.start(0)
    for _ in range(101):
        engine.handle_timeout(engine.next_timeout())
    handlers, channel.handlers = channel.handlers, []
    qualities = []
    for _ in range(80_000):
        for _ in range(2):
            engine.handle_timeout(engine.next_timeout())
        if len(qualities) < 6000:
            qualities.append(station_status(taken, 0)["pd"]["rx"][0]["quality"])
    assert qualities == list(range(10, 60_010, 10))
    row = station_status(taken, 0)["pd"]["rx"][0]
    assert (row["quality"], row["state"], row["timeouts"]) == (65_535, "stale", 1)
    channel.handlers = handlers
    for _ in range(10):
        engine.handle_timeout(engine.next_timeout())
    row = station_status(taken, 0)["pd"]["rx"][0]
    assert (row["lost"], row["quality"], row["state"]) == (80_000, 0, "running")
    assert sent.read("n") == taken.read("n")


class PairMachine(RuleBasedStateMachine):
    """Whatever is written, suppressed, dropped and doubled, what was received is what was sent."""

    def __init__(self) -> None:
        super().__init__()
        pds = (
            TxPdSpec("cyclic", 1, ("x", "b")),
            TxPdSpec("changing", 2, ("y",), trigger=TriggerSpec(on_change=OnChangeSpec())),
            TxPdSpec("slow", 3, ("x",), trigger=TriggerSpec(cycle_us=3000)),
        )
        sender = station(
            ports=(eap_port("eap0", PEER),),
            variables=written("x:UINT", "b:BIT3", "y:UDINT"),
            frames=(TxFrameSpec("f", "eap0", "10.0.0.1", pds),),
        )
        common = {"publisher": PEER, "sender_cycle_us": 1000}
        handler = station(
            variables=received("x:UINT", "b:BIT3", "y:UDINT", "z:UINT"),
            subscriptions=(
                RxPdSpec("cyclic", "eap0", 1, ("x", "b"), step=1, **common),
                RxPdSpec("changing", "eap0", 2, ("y",), **common),
                RxPdSpec("slow", "eap0", 3, ("z",), step=3, **common),
            ),
        )
        self.sender, self.out = assemble(sender)
        self.handler, self.into = assemble(handler)
        self.sender.start(0)
        self.handler.start(0)
        self.now = 0
        self.delivered: dict[int, bytes] = {}
        self.arrivals: dict[int, list[int]] = {1: [], 2: [], 3: []}
        self.copies = 1

    @rule(x=st.integers(0, 0xFFFF), b=st.integers(0, 7))
    def write_what_is_sent_cyclically(self, x: int, b: int) -> None:
        with self.out.image.writing(Writer.APPLICATION):
            self.out.image.write("x", x)
            self.out.image.write("b", b)

    @rule(y=st.integers(0, 3))
    def write_what_is_sent_on_change(self, y: int) -> None:
        with self.out.image.writing(Writer.APPLICATION):
            self.out.image.write("y", y)

    @rule(
        name=st.sampled_from(["cyclic.VarCtrl", "changing.VarCtrl", "slow.VarCtrl", "f.FrameCtrl"]),
        suppress=st.booleans(),
    )
    def set_control_bits(self, name: str, suppress: bool) -> None:
        with self.out.image.writing(Writer.APPLICATION):
            self.out.image.write(name, int(suppress))

    @rule(copies=st.sampled_from([0, 1, 1, 2]))
    def the_line_becomes(self, copies: int) -> None:
        self.copies = copies

    @rule(cycles=st.integers(1, 5))
    def time_passes(self, cycles: int) -> None:
        for _ in range(cycles):
            self.now += MS
            self.sender.cycle(self.now, self.now)
            frames, self.out.sent = self.out.sent, []
            for frame in frames * self.copies:
                self.into.waiting.append((frame, self.now))
                for pd, data in iter_pds(frame):
                    self.delivered[pd.pd_id] = bytes(data)
                    self.arrivals[pd.pd_id].append(int.from_bytes(frame[10:12], "little"))
            self.handler.cycle(self.now, self.now)

    @rule()
    def both_engines_are_restarted(self) -> None:
        self.sender, self.out = assemble(self.sender.spec, self.out.image)
        self.handler, self.into = assemble(self.handler.spec, self.into.image)
        self.sender.start(self.now)
        self.handler.start(self.now)

    @invariant()
    def what_was_received_is_what_was_sent_last(self) -> None:
        layout = self.into.image.layout
        for slot in layout.rx:
            if slot.pd_id in self.delivered:
                start = slot.offset + 8
                data = bytes(self.into.image.memory[start : start + slot.size])
                assert data == self.delivered[slot.pd_id]

    @invariant()
    def every_cyclic_pd_was_received_or_lost(self) -> None:
        rows = {row["name"]: row for row in station_status(self.into.image, self.now)["pd"]["rx"]}
        for name, pd_id, step in (("cyclic", 1, 1), ("slow", 3, 3)):
            row, seen = rows[name], self.arrivals[pd_id]
            assert row["received"] == len(seen)
            assert row["duplicated"] == len(seen) - len(set(seen))
            if seen:
                span = (seen[-1] - seen[0]) // step + 1
                assert row["received"] - row["duplicated"] + row["lost"] == span
        assert rows["changing"]["lost"] is None
        assert station_status(self.into.image, 0)["discarded"] == {}

    @invariant()
    def every_reason_adds_up(self) -> None:
        for row in station_status(self.out.image, 0)["pd"]["tx"]:
            assert row["sent"] == sum(row["reason"].values())


PairMachine.TestCase.settings = examples(50, stateful_step_count=30)

TestPairMachine = PairMachine.TestCase
