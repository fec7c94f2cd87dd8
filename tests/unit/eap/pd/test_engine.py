from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.pd.engine import SOON_NS, Engine
from eap.pd.spec import (
    CounterSource,
    RampSource,
    RandomSource,
    RxPdSpec,
    SineSource,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.station import Station
from eap.pd.words import HISTOGRAM_BINS, StationWord, bin_upper_edge, histogram_bin
from tests.support.cyclic import (
    MS,
    PEER,
    FakeBus,
    Wire,
    bus_port,
    entries,
    image_of,
    octets,
    received,
    slave,
    station,
    written,
)


def make(name: str = "a", **options: object) -> tuple[Station, Wire]:
    spec = station(
        name,
        variables=written("x:UINT"),
        frames=(TxFrameSpec("f", "eap0", "10.0.0.1", (TxPdSpec("p", 1, ("x",)),)),),
        **options,
    )
    wire = Wire()
    made = Station(spec, image_of(spec), lambda: None)
    made.connect("eap0", wire)
    return made, wire


def run(engine: Engine, until_ns: int) -> list[int]:
    times = []
    while (now := engine.next_timeout()) <= until_ns:
        engine.handle_timeout(now)
        times.append(now)
    return times


def test_stations_run_on_their_own_grid_and_phase():
    fast, fast_wire = make("fast")
    slow, slow_wire = make("slow", cycle_us=4000, phase_us=500)
    engine = Engine([fast, slow])
    engine.start(10 * MS + 1)
    assert run(engine, 16 * MS) == [11 * MS, 12 * MS, 12_500_000, *(n * MS for n in range(13, 17))]
    assert (len(fast_wire.sent), len(slow_wire.sent)) == (6, 1)


def test_a_start_before_the_phase_of_this_cycle_does_not_wait_for_the_next():
    made, _ = make(phase_us=700)
    engine = Engine([made])
    engine.start(5 * MS + 100_000)
    assert engine.next_timeout() == 5 * MS + 700_000


def test_engine_is_under_way_without_stations_with_long_cycles():
    fast, _ = make("fast")
    slow, _ = make("slow", cycle_us=4000)
    minute, _ = make("minute", cycle_us=60_000_000, phase_us=59_000_000)
    assert minute.cycle_ns > SOON_NS
    engine = Engine([fast, slow, minute])
    engine.start(10 * MS)
    run(engine, 11 * MS)
    assert (fast.has_run, slow.has_run, engine.is_under_way) == (True, False, False)
    run(engine, 12 * MS)
    assert (slow.has_run, minute.has_run, engine.is_under_way) == (True, False, True)
    engine.start(13 * MS)  # as one that was started again, on the same image
    assert not engine.is_under_way
    run(engine, 16 * MS)
    assert engine.is_under_way


def test_engine_early_timeout_does_nothing():
    made, wire = make()
    engine = Engine([made])
    engine.start(0)
    engine.handle_timeout(MS - 1)
    assert wire.sent == []


def test_cycles_that_are_missed_are_counted_and_left_out_and_the_grid_stays():
    made, wire = make()
    engine = Engine([made])
    engine.start(0)
    engine.handle_timeout(MS)
    engine.handle_timeout(5 * MS + MS // 2)  # 2 runs late, 3, 4 and 5 are left out
    assert made.image.words[StationWord.OVERRUNS] == 3
    assert engine.next_timeout() == 6 * MS
    engine.handle_timeout(6 * MS)
    assert [frame[10] for frame in wire.sent] == [1, 2, 3]


def lateness_us(made: Station) -> list[int]:
    """Return the upper edges of the bins with the lateness of all cycles of a station."""
    bins = made.image.words[StationWord.LATENESS : StationWord.LATENESS + HISTOGRAM_BINS]
    return [bin_upper_edge(n) for n, count in enumerate(bins) for _ in range(count)]


def run_group(engine: Engine, stations: int, due_ns: int, *behind_us: int) -> None:
    """Run a group of *stations*; the others begin *behind_us* after the first."""
    for number, each in enumerate((0, *behind_us), start=1):
        assert engine.next_timeout() == due_ns
        engine.handle_timeout(due_ns + each * 1000)
        assert engine.is_within_group == (number < stations)


def test_lateness_in_a_group_counts_from_the_usual_place():
    first, second, third = (make(name)[0] for name in ("a", "b", "c"))
    engine = Engine([first, second, third])
    engine.start(0)
    for cycle in range(1, 11):
        run_group(engine, 3, cycle * MS, 100, 300)
    run_group(engine, 3, 11 * MS, 100, 500)
    assert lateness_us(second) == [0] * 11
    assert lateness_us(third) == [0] * 10 + [bin_upper_edge(histogram_bin(199))]
    behind = [each.image.words[StationWord.BEHIND_NS] for each in (first, second, third)]
    assert behind == [0, 100_000, 301_000]  # a single long cycle hardly moves a place


def test_a_place_in_a_group_recovers_from_a_slow_start():
    first, second = make("a")[0], make("b")[0]
    engine = Engine([first, second])
    engine.start(0)
    run_group(engine, 2, MS, 900)
    for cycle in range(2, 101):
        run_group(engine, 2, cycle * MS, 50)
    assert second.image.words[StationWord.BEHIND_NS] == 50_000


def test_shorter_cycles_run_first_in_a_group_and_alone_have_no_place():
    slow, slow_wire = make("slow", cycle_us=2000)
    fast, fast_wire = make("fast")
    engine = Engine([slow, fast])
    engine.start(MS)
    engine.handle_timeout(2 * MS)
    assert (len(fast_wire.sent), len(slow_wire.sent)) == (1, 0)
    engine.handle_timeout(2 * MS + 40_000)
    engine.handle_timeout(3 * MS + 7000)  # fast alone
    assert (len(fast_wire.sent), len(slow_wire.sent)) == (2, 1)
    assert lateness_us(fast) == [0, 7]
    assert fast.image.words[StationWord.BEHIND_NS] == 0


@given(
    st.lists(st.tuples(st.sampled_from([1, 2, 3, 5]), st.integers(0, 4)), min_size=1, max_size=6),
    st.lists(st.integers(0, 2 * MS), min_size=10, max_size=60),
)
def test_every_station_runs_or_leaves_out_each_of_its_cycles(shapes, delays_ns):
    made = [
        make(f"s{n}", cycle_us=cycle * 1000, phase_us=min(phase, cycle - 1) * 1000)[0]
        for n, (cycle, phase) in enumerate(shapes)
    ]
    engine, now_ns = Engine(made), 0
    first = {id(each): each.spec.phase_us * 1000 or each.cycle_ns for each in made}
    engine.start(0)
    for delay_ns in delays_ns:
        now_ns = max(now_ns, engine.next_timeout()) + delay_ns
        engine.handle_timeout(now_ns)
    for each in made:
        words = each.image.words
        cycles = words[StationWord.CYCLE]
        assert sum(words[StationWord.LATENESS : StationWord.LATENESS + HISTOGRAM_BINS]) == cycles
        assert 0 <= words[StationWord.BEHIND_NS] <= now_ns
        if cycles:  # the grid of due times has neither a gap nor an extra cycle
            due_ns = words[StationWord.CYCLE_AT_NS]
            assert due_ns % each.cycle_ns == first[id(each)] % each.cycle_ns
            left_out = words[StationWord.OVERRUNS]
            ran = (due_ns - first[id(each)]) // each.cycle_ns + 1
            # Those that a cycle leaves out lie behind it.
            assert cycles <= ran <= cycles + left_out


def test_generated_values_after_skipped_cycles_and_restart_are_those_of_their_time():
    sources = (
        CounterSource("counter"),
        RampSource("ramp", 0, 100, period_ms=50),
        SineSource("sine", 2, period_ms=30),
        RandomSource("noise"),
    )
    kinds = {"counter": "UDINT", "ramp": "LREAL", "sine": "LREAL", "noise": "BLOCK(8)"}
    variables = tuple(VariableSpec(name, kind, Writer.ENGINE) for name, kind in kinds.items())
    spec = station(variables=variables, sources=sources)

    def started(image=None) -> tuple[Engine, Station]:
        made = Station(spec, image or image_of(spec), lambda: None)
        engine = Engine([made])
        engine.start(0 if image is None else 81 * MS)
        return engine, made

    punctual, expected = started()
    run(punctual, 100 * MS)
    engine, made = started()
    run(engine, 20 * MS)
    engine.handle_timeout(61 * MS + 1)  # 21 runs, 22 to 61 are left out
    run(engine, 70 * MS)
    assert made.image.words[StationWord.OVERRUNS] == 40
    assert made.image.read("counter") == 70
    engine, made = started(made.image)  # another engine, 11 ms later
    run(engine, 100 * MS)
    assert made.image.read_all() == expected.image.read_all()


def test_the_stop_ends_sending_and_receiving():
    made, wire = make()
    engine = Engine([made])
    engine.start(0)
    run(engine, 3 * MS)
    engine.stop()
    assert made.image.words[StationWord.STATE] == 2
    assert len(wire.sent) == 3


def with_bus() -> tuple[Station, FakeBus]:
    spec = station(
        ports=(bus_port(slave(entries("i:8"))),), variables=received("i:USINT"), cycle_us=4000
    )
    made = Station(spec, image_of(spec), lambda: None)
    bus = FakeBus(made)
    made.connect_bus(bus)
    return made, bus


def test_a_bus_that_is_due_between_two_cycles_has_its_turn():
    (made, bus), (other, late) = with_bus(), with_bus()
    engine = Engine([made, other])
    engine.start(0)
    bus.due_ns, late.due_ns = MS + 5, MS + 3
    assert engine.next_timeout() == MS + 3
    engine.handle_timeout(MS + 2)
    assert bus.log == late.log == []
    engine.handle_timeout(MS + 7)
    assert (bus.log, late.log) == ([], [f"timeout {MS + 7}"])
    assert engine.next_timeout() == MS + 5
    engine.handle_timeout(MS + 8)
    assert bus.log == [f"timeout {MS + 8}"]
    assert engine.next_timeout() == 4 * MS


def test_stations_come_before_buses():
    made, bus = with_bus()
    other, late = with_bus()
    engine = Engine([made, other])
    engine.start(0)
    bus.due_ns = late.due_ns = 3 * MS
    for _ in range(3):
        engine.handle_timeout(4 * MS)
    assert made.image.words[StationWord.CYCLE] == other.image.words[StationWord.CYCLE] == 1
    # Each station ran the timer of its own bus.
    assert bus.log.count(f"timeout {4 * MS}") == late.log.count(f"timeout {4 * MS}") == 1


def test_engine_receives_bus_frames_on_arrival():
    made, bus = with_bus()
    engine = Engine([made])
    engine.start(0)
    engine.receive(MS)
    assert bus.log == [f"receive {MS}"]


def test_frames_are_taken_as_they_arrive_where_that_is_wanted():
    spec = station(
        variables=received("x:UINT"), subscriptions=(RxPdSpec("r", "eap0", 7, ("x",), PEER),)
    )
    made = Station(spec, image_of(spec), lambda: None)
    wire = Wire()
    wire.handlers.append(made.handlers["eap0"])
    made.connect("eap0", wire)
    engine = Engine([made])
    engine.drain_on_arrival([wire])
    engine.start(0)
    engine.handle_timeout(MS)
    wire.waiting.append((octets([(7, b"\x05\0")]), MS + 100))
    engine.receive(MS + 200)
    assert made.image.words[StationWord.ENGINE_SEQUENCE] % 2 == 0
    assert made.image.read("x") == 5


@pytest.mark.parametrize(
    ("before_us", "after_us", "now_ns", "due_ns"),
    [
        (1000, 1000, 0, 2 * MS),
        (1000, 5000, 0, 6 * MS),
        (10_000, 1000, 12 * MS, 12 * MS),
        (10_000, 1000, 15 * MS + 1, 16 * MS),  # what was not due before has not been missed
    ],
)
def test_a_station_that_is_replaced_may_have_another_cycle(before_us, after_us, now_ns, due_ns):
    old, new = (
        Station(spec, image_of(spec), lambda: None)
        for spec in (station(cycle_us=cycle_us) for cycle_us in (before_us, after_us))
    )
    engine = Engine([old])
    engine.start(0)
    engine.handle_timeout(engine.next_timeout())
    new.start(0)
    engine.replace(old, new, now_ns)
    assert engine.next_timeout() == due_ns
    engine.handle_timeout(due_ns)
    assert new.image.words[StationWord.CYCLE] == 1
    assert new.image.words[StationWord.OVERRUNS] == 0


def test_station_that_follows_a_clock_runs_at_its_step():
    fast, _ = make("fast")
    engine = Engine([fast])
    engine.start(10 * MS)
    run(engine, 11 * MS)
    fast.step_ns = MS + 700
    assert run(engine, 14 * MS)[1:] == [13 * MS + 700]
    fast.step_ns = MS
    assert run(engine, 15 * MS) == [14 * MS + 1400]
