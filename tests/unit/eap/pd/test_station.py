"""The cycle of a station: its order, its restart, and two stations on a line with faults."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from eap.codec.pd import iter_pds
from eap.errors import LocalProtocolError
from eap.ids import InterfaceUri
from eap.net.loopback import LoopbackChannel, LoopbackLines
from eap.pd.device import DeviceState
from eap.pd.engine import Engine
from eap.pd.image import Image
from eap.pd.report import station_status
from eap.pd.spec import (
    CounterSource,
    LinkSpec,
    OnChangeSpec,
    RxPdSpec,
    StationSpec,
    Substitute,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.station import WAKE_FOR_CYCLES, Station
from eap.pd.words import StationWord
from tests.support.cyclic import (
    MS,
    OWN,
    PEER,
    SECOND,
    FakeBus,
    From,
    Wire,
    bus_port,
    eap_port,
    entries,
    give,
    image_of,
    octets,
    received,
    slave,
    station,
    written,
)
from tests.support.runstations import (
    addressed,
    assemble,
    moody,
    sent_ids,
)

THIRD = "5.99.99.99.1.1"


def forwarder() -> StationSpec:
    """Receives r, counts n, and sends both with the application's x in each cycle."""
    return station(
        variables=(
            VariableSpec("r", "UINT", Writer.ENGINE, default=777),
            VariableSpec("n", "UINT", Writer.ENGINE),
            VariableSpec("x", "UINT"),
        ),
        sources=(CounterSource("n"),),
        subscriptions=(
            RxPdSpec("in", "eap0", 7, ("r",), PEER, timeout_ms=3, substitute=Substitute.DEFAULT),
        ),
        frames=(TxFrameSpec("f", "eap0", "10.0.0.1", (TxPdSpec("out", 1, ("r", "n", "x")),)),),
    )


def last_values(wire: Wire) -> tuple[int, ...]:
    (_, data), *_ = iter_pds(wire.sent[-1])
    return tuple(int.from_bytes(data[at : at + 2], "little") for at in (0, 2, 4))


def test_the_order_of_a_cycle():
    """Take frames, time-outs, generators, what others wrote, triggers, patch and send, wake."""
    made, wire = assemble(forwarder())
    made.start(0)
    assert wire.log == ["wake"]
    wire.log.clear()
    wire.waiting.append((octets([(7, b"\x05\0")], cycle=1), MS - 1000))
    with wire.image.writing(Writer.APPLICATION):
        wire.image.write("x", 9)
    made.cycle(MS, MS)
    # Frames first, marked as changing; the send after everything, in calm; waiters last.
    assert wire.log == [f"drain {MS}", "changing", "calm", f"send {MS}", "wake"]
    # What was received, generated and written before is in the frame of the same cycle.
    assert last_values(wire) == (5, 1, 9)
    made.cycle(2 * MS, 2 * MS)
    made.cycle(3 * MS, 3 * MS)
    # A frame that waits when its time-out comes is taken first, so there is none.
    wire.waiting.append((octets([(7, b"\x06\0")], cycle=3), 4 * MS - 500))
    made.cycle(4 * MS, 4 * MS)
    assert last_values(wire) == (6, 4, 9)
    # A substitute that applies in a cycle is sent in that cycle.
    made.cycle(7 * MS, 7 * MS)
    assert last_values(wire) == (777, 5, 9)
    assert station_status(wire.image, 0)["pd"]["rx"][0]["timeouts"] == 1


def with_a_bus() -> StationSpec:
    """Its valve follows its switch, and so does what it sends with r, n and x."""
    return station(
        ports=(
            eap_port(),
            bus_port(
                slave(entries("switch:1", ":7", "level:16"), entries("valve:1", "lamp:1", ":6"))
            ),
        ),
        variables=(
            *received("r:UINT", "switch:BOOL", "level:UINT", "valve:BOOL", "n:UINT", "sum:UINT"),
            *written("x:UINT", "lamp:BOOL"),
        ),
        sources=(CounterSource("n"),),
        subscriptions=(RxPdSpec("in", "eap0", 7, ("r",), PEER),),
        links=(
            LinkSpec("switch", "valve"),
            LinkSpec("level", "sum", scale=10.0),
            LinkSpec("n", "sum", bits=4),
            LinkSpec("x", "sum", target_bit=4, bits=4),
            LinkSpec("r", "sum", target_bit=8, bits=4),
        ),
        frames=(
            TxFrameSpec("f", "eap0", "10.0.0.1", (TxPdSpec("out", 1, ("level", "sum", "x")),)),
        ),
    )


def test_the_order_of_a_cycle_with_a_bus():
    """Frames and time-outs of all ports, inputs, generators, others, links, sending, exchange."""
    made, wire = assemble(with_a_bus())
    bus = FakeBus(made, log=wire.log)
    made.connect_bus(bus)
    made.start(0)
    made.cycle(MS, MS)
    bus.inputs[:] = b"\x01\x34\x12"
    made.cycle(2 * MS, 2 * MS)
    assert bus.outputs == b"\0"
    wire.log.clear()
    bus.due_ns = 3 * MS
    wire.waiting.append((octets([(7, b"\x05\0")], cycle=1), 3 * MS - 1000))
    with wire.image.writing(Writer.APPLICATION):
        wire.image.write("x", 9)
        wire.image.write("lamp", True)
    made.cycle(3 * MS, 3 * MS)
    assert [line.split()[0] for line in wire.log] == [
        "drain", "changing", "receive", "timeout", "take", "calm", "send", "exchange", "wake",
    ]  # fmt: skip
    assert "take changing" in wire.log
    # Inputs of the exchange before went through the links in this cycle: to the other stations,
    # with what was received, generated and written, and to the outputs of the bus.
    assert last_values(wire) == (0x1234, 10 * 0x1234 & 0xF000 | 0x593, 9)
    assert bus.outputs == b"\x03"


def test_timers_of_a_bus_run_in_the_cycle_only_when_they_are_due():
    made, _ = assemble(with_a_bus())
    bus = FakeBus(made)
    made.connect_bus(bus)
    made.start(0)
    bus.due_ns = 2 * MS
    made.cycle(MS, MS)
    assert f"timeout {MS}" not in bus.log
    made.cycle(2 * MS, 2 * MS)
    assert f"timeout {2 * MS}" in bus.log


def test_a_station_may_have_two_buses_and_nothing_else():
    spec = station(
        ports=(
            bus_port(slave(entries("in0:8"), entries("out0:8"))),
            bus_port(slave(entries("in1:8"), entries("out1:8")), name="bus1"),
        ),
        variables=received("in0:USINT", "out0:USINT", "in1:USINT", "out1:USINT"),
        links=(LinkSpec("in0", "out1"), LinkSpec("in1", "out0")),
    )
    made = Station(spec, image_of(spec), lambda: None)
    assert made.takers == {}
    halves = []
    for number in (0, 1):
        half = FakeBus(made, only=number)
        made.connect_bus(half)
        halves.append(half)
        half.inputs[:] = bytes([number + 1])
    made.start(0)
    for n in range(1, 3):
        made.cycle(n * MS, n * MS)
    assert [bytes(half.outputs) for half in halves] == [b"\x02", b"\x01"]
    assert made.buses == halves


def test_inputs_of_a_bus_keep_their_values_over_a_restart():
    spec = with_a_bus()
    made, wire = assemble(spec)
    bus = FakeBus(made)
    made.connect_bus(bus)
    made.start(0)
    bus.inputs[:] = b"\x01\x34\x12"
    for n in range(1, 3):
        made.cycle(n * MS, n * MS)
    made, wire = assemble(spec, wire.image)
    made.start(3 * MS)
    made.cycle(4 * MS, 4 * MS)
    assert wire.image.read("level") == 0x1234
    assert wire.image.read("valve") is True


def test_a_switch_on_one_stations_bus_opens_a_valve_on_anothers_bus():
    """Input, link, EAP, link, output: two cycles of the first station, one of the second."""
    lines = LoopbackLines()
    left = station(
        "left",
        ports=(eap_port("eap0", PEER), bus_port(slave(entries("switch:1", ":7")))),
        variables=received("switch:BOOL", "limit:BOOL"),
        links=(LinkSpec("switch", "limit"),),
        frames=(TxFrameSpec("f", "eap0", "10.0.0.1", (TxPdSpec("state", 7, ("limit",)),)),),
    )
    right = station(
        "right",
        phase_us=500,
        ports=(eap_port(), bus_port(slave(outputs=entries("lamp:1", "valve:1", ":6")))),
        variables=(*received("limit:BOOL", "valve:BOOL"), *written("lamp:BOOL")),
        links=(LinkSpec("limit", "valve"),),
        subscriptions=(RxPdSpec("left", "eap0", 7, ("limit",), PEER, timeout_ms=5),),
    )
    stations, buses = [], []
    for spec in (left, right):
        channel = lines.open(InterfaceUri.parse("loop://between"))
        made = Station(spec, image_of(spec), lambda: None)
        channel.takers.append(made.takers["eap0"])
        made.connect("eap0", channel)
        buses.append(FakeBus(made))
        made.connect_bus(buses[-1])
        stations.append(made)
    engine = Engine(stations)
    engine.start(0)
    while engine.next_timeout() < 10 * MS:
        engine.handle_timeout(engine.next_timeout())
    switch, valve = buses
    for state in (1, 0, 1):
        switch.inputs[0] = state
        before = valve.outputs[0]
        assert before == 2 * (1 - state)
        seen = []
        for _ in range(4):  # cycles of left and right in turn
            engine.handle_timeout(engine.next_timeout())
            seen.append(valve.outputs[0])
        assert seen == [before, before, before, 2 * state]


def test_a_restarted_engine_goes_on_as_if_it_had_never_stopped():
    spec = forwarder()
    made, wire = assemble(spec)
    engine = Engine([made])
    engine.start(0)
    for _ in range(5):
        engine.handle_timeout(engine.next_timeout())
    assert wire.image.words[StationWord.CYCLE] == 5
    wire.image.words[StationWord.ENGINE_SEQUENCE] += 1  # killed in the middle of a cycle
    made, wire = assemble(spec, wire.image)
    engine = Engine([made])
    engine.start(SECOND + MS // 3)
    assert engine.next_timeout() == SECOND + MS
    assert wire.image.words[StationWord.RESTARTS] == 1
    assert wire.image.words[StationWord.ENGINE_SEQUENCE] % 2 == 0
    engine.handle_timeout(SECOND + MS)
    assert wire.image.words[StationWord.CYCLE] == 1001
    assert int.from_bytes(wire.sent[-1][10:12], "little") == 1001
    assert last_values(wire)[1] == 1001  # generated values go on too
    assert station_status(wire.image, 0)["pd"]["tx"][0]["sent"] == 6


def test_a_host_that_was_booted_begins_a_new_grid():
    spec = forwarder()
    made, wire = assemble(spec)
    wire.image.words[StationWord.CYCLE_AT_NS] = 10**15
    assert made.start(5 * MS) == 6 * MS
    assert wire.image.words[StationWord.RESTARTS] == 0
    assert not made.has_run


def test_lateness_is_kept_as_a_histogram_with_its_maximum():
    made, wire = assemble(forwarder())
    made.start(0)
    made.cycle(MS, MS + 40_000)
    made.cycle(2 * MS, 2 * MS + 9 * MS)
    made.cycle(12 * MS, 12 * MS - 1)
    lateness = station_status(wire.image, 0)["lateness_us"]
    assert lateness["max"] == 9000
    assert 40 <= lateness["p50"] <= 50
    assert lateness["p99"] >= 9000


def test_programs_are_woken_as_long_as_some_came_lately():
    made, wire = assemble(forwarder())
    wire.image.words[StationWord.CYCLE] = 1000
    made.start(0)
    wire.log.clear()
    made.cycle(MS, MS)
    assert "wake" not in wire.log
    wire.image.words[StationWord.WAITERS] = 1001
    for n in range(WAKE_FOR_CYCLES):
        made.cycle((2 + n) * MS, (2 + n) * MS)
    assert wire.log.count("wake") == WAKE_FOR_CYCLES
    made.cycle(SECOND, SECOND)
    assert wire.log.count("wake") == WAKE_FOR_CYCLES
    assert wire.image.words[StationWord.FUTEX] == wire.image.words[StationWord.CYCLE] & 0xFFFFFFFF


def test_two_ports_send_under_their_own_net_ids_and_take_their_own_subscriptions():
    spec = station(
        ports=(eap_port("left", OWN), eap_port("right", THIRD)),
        variables=(*written("x:UINT"), *received("l:UINT", "r:UINT")),
        frames=(
            TxFrameSpec("fl", "left", "10.0.0.1", (TxPdSpec("pl", 1, ("x",)),)),
            TxFrameSpec("fr", "right", "10.0.0.1", (TxPdSpec("pr", 1, ("x",)),)),
        ),
        subscriptions=(
            RxPdSpec("from_left", "left", 7, ("l",), PEER),
            RxPdSpec("from_right", "right", 7, ("r",), PEER),
        ),
    )
    image = image_of(spec)
    made = Station(spec, image, lambda: None)
    left, right, group = Wire(), Wire(), Wire()
    for wire, port in ((left, "left"), (right, "right"), (group, "right")):
        wire.takers.append(made.takers[port])
    made.connect("left", left)
    made.connect("right", right)
    made.drain_also(group)
    made.drain_also(group)
    made.start(0)
    left.waiting.append((octets([(7, b"\x01\0")]), 10))
    group.waiting.append((octets([(7, b"\x02\0")]), 10))
    made.cycle(MS, MS)
    assert (image.read("l"), image.read("r")) == (1, 2)
    assert [bytes(wire.sent[0][2:8]) for wire in (left, right)] == [
        bytes(int(part) for part in net_id.split(".")) for net_id in (OWN, THIRD)
    ]
    assert group.sent == []
    assert group.log == [f"drain {MS}"]


def test_after_the_stop_frames_are_suppressed_not_taken():
    made, wire = assemble(forwarder())
    made.start(0)
    made.cycle(MS, MS)
    made.stop()
    wire.waiting.append((octets([(7, b"\x05\0")]), 2 * MS))
    wire.drain(2 * MS)
    assert station_status(wire.image, 0)["discarded"] == {"suppressed": 1}


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
    taker = station(
        "taker",
        phase_us=500,
        variables=received("n:UDINT"),
        subscriptions=(RxPdSpec("r", "eap0", 7, ("n",), PEER, **PAIR),),
    )
    arrived: list[int] = []
    images, stations = [], []
    for spec, uri in ((sender, f"loop://line{options}"), (taker, "loop://line")):
        channel = lines.open(InterfaceUri.parse(uri))
        image = image_of(spec)
        made = Station(spec, image, lambda: None)
        if spec is taker:
            channel.takers.append(
                lambda data, size, at_ns, _: arrived.append(int.from_bytes(data[10:12], "little"))
            )
        channel.takers.append(made.takers["eap0"])
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
    takers, channel.takers = channel.takers, []
    qualities = []
    for _ in range(80_000):
        for _ in range(2):
            engine.handle_timeout(engine.next_timeout())
        if len(qualities) < 6000:
            qualities.append(station_status(taken, 0)["pd"]["rx"][0]["quality"])
    assert qualities == list(range(10, 60_010, 10))
    row = station_status(taken, 0)["pd"]["rx"][0]
    assert (row["quality"], row["state"], row["timeouts"]) == (65_535, "stale", 1)
    channel.takers = takers
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
        taker = station(
            variables=received("x:UINT", "b:BIT3", "y:UDINT", "z:UINT"),
            subscriptions=(
                RxPdSpec("cyclic", "eap0", 1, ("x", "b"), step=1, **common),
                RxPdSpec("changing", "eap0", 2, ("y",), **common),
                RxPdSpec("slow", "eap0", 3, ("z",), step=3, **common),
            ),
        )
        self.sender, self.out = assemble(sender)
        self.taker, self.into = assemble(taker)
        self.sender.start(0)
        self.taker.start(0)
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
            self.taker.cycle(self.now, self.now)

    @rule()
    def both_engines_are_restarted(self) -> None:
        self.sender, self.out = assemble(self.sender.spec, self.out.image)
        self.taker, self.into = assemble(self.taker.spec, self.into.image)
        self.sender.start(self.now)
        self.taker.start(self.now)

    @invariant()
    def what_was_received_is_what_was_sent_last(self) -> None:
        layout = self.into.image.layout
        for place in layout.rx:
            if place.pd_id in self.delivered:
                start = place.offset + 8
                data = bytes(self.into.image.memory[start : start + place.size])
                assert data == self.delivered[place.pd_id]

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


PairMachine.TestCase.settings = settings(max_examples=50, stateful_step_count=30)
TestPairMachine = PairMachine.TestCase


def test_frames_to_a_net_id_go_where_its_own_frames_come_from():
    spec = addressed()
    made, wire = assemble(spec)
    made.start(0)
    made.cycle(MS, MS)
    assert [pd.pd_id for frame in wire.sent for pd, _ in iter_pds(frame)] == [2]
    frame = octets([(9, b"\0\0")])
    made.takers["eap0"](memoryview(frame), len(frame), 2 * MS, From("02:00:00:00:00:07"))
    wire.sent.clear()
    made.cycle(2 * MS, 2 * MS)
    assert sorted(pd.pd_id for frame in wire.sent for pd, _ in iter_pds(frame)) == [1, 2]
    by_id, by_mac = station_status(made.image, 0)["frames"]
    assert (by_id["address"], by_mac["address"]) == ("02:00:00:00:00:07", "02:00:00:00:00:05")


def test_below_op_nothing_is_received_and_below_safeop_nothing_sent():
    made, wire = assemble(moody())
    made.start(0, DeviceState.PREOP)
    take = made.takers["eap0"]

    def run(at: int) -> list[int]:
        give(take, octets([(7, b"\5\0")], cycle=at), at * MS)
        made.cycle(at * MS, at * MS)
        return sent_ids(wire)

    assert run(1) == []
    made.go(DeviceState.SAFEOP, MS)
    assert run(2) == [1, 3]
    assert run(3) == [3]
    made.go(DeviceState.OP, 3 * MS)
    assert run(4) == [3]
    made.go(DeviceState.PREOP, 4 * MS)
    assert run(5) == []
    made.go(DeviceState.OP, 50 * MS)
    assert run(51) == [1, 3]  # what goes by change goes first, as after a start
    rx = station_status(made.image, SECOND)["pd"]["rx"][1]
    assert (rx["received"], rx["lost"], rx["timeouts"]) == (2, None, 0)
    assert station_status(made.image, SECOND)["discarded"] == {"suppressed": 4}
    with pytest.raises(LocalProtocolError, match="INIT cannot be requested"):
        made.go(DeviceState.INIT, SECOND)
