"""The cycle of a station with buses."""

from __future__ import annotations

from eap.ids import InterfaceUri
from eap.net.loopback import LoopbackLines
from eap.pd.engine import Engine
from eap.pd.spec import (
    CounterSource,
    LinkSpec,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    Writer,
)
from eap.pd.station import Station
from tests.support.cyclic import (
    MS,
    PEER,
    FakeBus,
    bus_port,
    eap_port,
    entries,
    image_of,
    octets,
    received,
    slave,
    station,
    written,
)
from tests.support.runstations import (
    assemble,
)
from tests.unit.eap.pd.test_station import last_values


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


def test_station_runs_with_two_buses_only():
    spec = station(
        ports=(
            bus_port(slave(entries("in0:8"), entries("out0:8"))),
            bus_port(slave(entries("in1:8"), entries("out1:8")), name="bus1"),
        ),
        variables=received("in0:USINT", "out0:USINT", "in1:USINT", "out1:USINT"),
        links=(LinkSpec("in0", "out1"), LinkSpec("in1", "out0")),
    )
    made = Station(spec, image_of(spec), lambda: None)
    assert made.handlers == {}
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
        channel.handlers.append(made.handlers["eap0"])
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
