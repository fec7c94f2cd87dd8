"""The cycle of a station: its order, its restart, and its ports."""

from __future__ import annotations

import pytest

from eap.codec.pd import iter_pds
from eap.errors import LocalProtocolError
from eap.pd.device import DeviceState
from eap.pd.engine import Engine
from eap.pd.report import station_status
from eap.pd.spec import (
    CounterSource,
    RxPdSpec,
    StationSpec,
    Substitute,
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
    From,
    Wire,
    eap_port,
    give,
    image_of,
    octets,
    received,
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


def test_station_continues_cycle_of_restarted_engine():
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
        wire.handlers.append(made.handlers[port])
    made.connect("left", left)
    made.connect("right", right, [group, group])
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


def test_frames_to_a_net_id_go_where_its_own_frames_come_from():
    spec = addressed()
    made, wire = assemble(spec)
    made.start(0)
    made.cycle(MS, MS)
    assert [pd.pd_id for frame in wire.sent for pd, _ in iter_pds(frame)] == [2]
    frame = octets([(9, b"\0\0")])
    made.handlers["eap0"](memoryview(frame), len(frame), 2 * MS, From("02:00:00:00:00:07"))
    wire.sent.clear()
    made.cycle(2 * MS, 2 * MS)
    assert sorted(pd.pd_id for frame in wire.sent for pd, _ in iter_pds(frame)) == [1, 2]
    by_id, by_mac = station_status(made.image, 0)["frames"]
    assert (by_id["address"], by_mac["address"]) == ("02:00:00:00:00:07", "02:00:00:00:00:05")


def test_station_receives_in_op_only_and_sends_from_safeop():
    made, wire = assemble(moody())
    made.start(0, DeviceState.PREOP)
    take = made.handlers["eap0"]

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
