"""State kept by a reconfigured station: counters, trackers, values, addresses, triggers."""

from __future__ import annotations

import random
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from eap.ids import InterfaceUri, NetId
from eap.od.slave_config import OpMode, SlaveConfig
from eap.pd.handover import (
    ImageHandover,
    PortChanges,
    needs_new_start,
    port_changes,
    restarting_buses,
)
from eap.pd.image import Image
from eap.pd.layout import RxSlot, TxSlot
from eap.pd.monitor import SubscriberPresence
from eap.pd.quality import tracker_word
from eap.pd.report import station_status
from eap.pd.spec import (
    BusPortSpec,
    BusSlaveSpec,
    BusTarget,
    OnChangeSpec,
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    Substitute,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.station import Station
from eap.pd.words import FrameWord, RxWord, StationWord, TxWord
from tests.support.cyclic import (
    MS,
    PEER,
    SECOND,
    From,
    give,
    image_of,
    octets,
    received,
    station,
)
from tests.support.examples import examples
from tests.support.runstations import (
    addressed,
    assemble,
    moody,
    sent_ids,
    set_value,
    succeed,
    succeed_with_values,
)
from tests.unit.eap.conftest import eap_port, left

THIRD = "5.99.99.99.1.1"
VALUES: dict[str, list[Any]] = {
    "BOOL": [False, True],
    "BIT3": [1, 5, 7],
    "UINT": [1, 700, 65535],
    "LREAL": [0.5, -1e300],
    "STRING(3)": ["", "xyz"],
    "INT[2]": [(1, -2), (-300, 400)],
}
TYPES = st.sampled_from(list(VALUES))
TRIGGERS = st.sampled_from(
    [
        TriggerSpec(),
        TriggerSpec(cycle_us=2000),
        TriggerSpec(divider=3, modulo=1),
        TriggerSpec(on_change=OnChangeSpec(5)),
        TriggerSpec(event=True),
    ]
)


@st.composite
def specs(draw: st.DrawFn) -> StationSpec:
    """A station of some frames, PDs and subscriptions, all from few names."""
    variables: list[VariableSpec] = []

    def pdo(owner: str, writer: Writer) -> tuple[str, ...]:
        names = draw(st.lists(st.sampled_from("abc"), min_size=1, unique=True))
        found = tuple(f"{owner}.{name}" for name in names)
        variables.extend(VariableSpec(name, draw(TYPES), writer) for name in found)
        return found

    rest = draw(st.permutations(["p", "q", "r", "s"]))
    frames = []
    for frame in draw(st.lists(st.sampled_from(["f", "g"]), unique=True)):
        own, rest = rest[:2], rest[2:]
        pds = tuple(
            TxPdSpec(name, 1 + ord(name), pdo(name, Writer.APPLICATION), 0, draw(TRIGGERS))
            for name in own[: draw(st.integers(1, 2))]
        )
        frames.append(TxFrameSpec(frame, "eap0", "10.0.0.1", pds))
    subscriptions = tuple(
        RxPdSpec(
            name,
            "eap0",
            draw(st.integers(1, 2)),
            pdo(name, Writer.ENGINE),
            draw(st.sampled_from([PEER, THIRD, ""])),
            timeout_ms=draw(st.sampled_from([0, 50])),
            step=draw(st.sampled_from([0, 1])),
            sender_cycle_us=1000,
        )
        for name in draw(st.permutations(["u", "v", "w", "x"]))[: draw(st.integers(0, 4))]
    )
    return station(variables=tuple(variables), frames=tuple(frames), subscriptions=subscriptions)


def used(image: Image, seed: int) -> Image:
    """Fill an image with numbers as a station that has run leaves them."""
    rest = random.Random(seed)
    words = image.words
    for index in range(StationWord.SIZE):
        words[index] = 2 * rest.randint(1, 1000)
    words[StationWord.STATE] = 8
    words[StationWord.RETIRED] = 0
    for tx in image.layout.tx:
        for word in range(TxWord.SIZE):
            words[tx.words + word] = rest.randint(1, 1000)
        words[tx.words + TxWord.LAST_REASON] = rest.randrange(5)
    for frame in image.layout.frames:
        own = [tx for tx in image.layout.tx if tx.frame == frame.name]
        words[frame.words + FrameWord.WHOLE] = rest.randint(0, 9) if all_scheduled(own) else 0
        words[frame.words + FrameWord.PARTIAL] = rest.randint(1, 1000)
    for rx in image.layout.rx:
        for word in range(RxWord.MISMATCH, RxWord.SIZE):
            words[rx.words + word] = rest.randint(1, 1000)
        words[rx.words + RxWord.STATE] = 1
    for slot in image.layout.variables:
        if slot.type in VALUES:
            image.write(slot.name, rest.choice(VALUES[slot.type]))
    return image


def all_scheduled(own: list[TxSlot]) -> bool:
    return all(tx.by_schedule for tx in own)


def shared(image: Image) -> dict[str, int]:
    return {rx.name: tracker_word(image, rx) for rx in image.layout.rx}


@examples(200)
@given(specs(), specs(), st.integers(0, 1 << 30))
def test_handover_keeps_objects_of_same_name(before, after, seed):
    old, new = image_of(before), image_of(after)
    Station(before, old, lambda: None)  # gives subscriptions their trackers
    used(old, seed)
    fresh = image_of(after)
    handover = ImageHandover(old, new)
    assert handover.is_current
    handover.carry_words()
    handover.carry_values(old.memory)
    Station(after, new, lambda: None)
    handover.commit()
    handover.carry_words()
    then, now = station_status(old, SECOND), station_status(new, SECOND)
    for key in now.keys() - {"pd", "frames"}:
        assert now[key] == then[key], key
    sent = {row["name"]: (row["sent"], row["skipped"]) for row in then["frames"]}
    for row in now["frames"]:
        assert (row["sent"], row["skipped"]) == sent.get(row["name"], (0, 0))
    check_values(old, new, fresh)
    unused = station_status(fresh, SECOND)["pd"]
    changed = {"port", "frame", "frame_state", "subscriber"}
    check_pds(then["pd"]["tx"], now["pd"]["tx"], unused["tx"], changed)
    changed = {"port", "lost", "quality", "cycle_index"}
    check_pds(then["pd"]["rx"], now["pd"]["rx"], unused["rx"], changed)
    check_trackers(old, new)


def check_values(old: Image, new: Image, fresh: Image) -> None:
    then, now, first = old.read_all(), new.read_all(), fresh.read_all()
    for name, slot in new.slots.items():
        stays = name in old.slots and old.slots[name].type == slot.type
        assert now[name] == (then if stays else first)[name]


def check_pds(
    then: list[dict[str, Any]],
    now: list[dict[str, Any]],
    unused: list[dict[str, Any]],
    changed: set[str],
) -> None:
    before = {pd["name"]: pd for pd in then}
    for pd, first in zip(now, unused, strict=True):
        was = before.get(pd["name"], first)
        for key in pd.keys() - changed:
            assert pd[key] == was[key], (pd["name"], key)


def check_trackers(old: Image, new: Image) -> None:
    """Check that PDs share a tracker only where they shared one, and have the same limits."""
    then, now = shared(old), shared(new)
    before = {slot.name: slot for slot in old.layout.rx}
    for slot in new.layout.rx:
        for other in new.layout.rx:
            if {slot.name, other.name} <= before.keys():
                together = (
                    then[slot.name] == then[other.name]
                    and limits_of(slot) == limits_of(other)
                    and stays(before[slot.name], slot) == stays(before[other.name], other)
                )
                assert (now[slot.name] == now[other.name]) == together
            elif slot.name in before:
                assert now[slot.name] != now[other.name]
        if slot.name in before:
            last = new.words[now[slot.name] + RxWord.LAST_CYCLE]
            known = old.words[then[slot.name] + RxWord.LAST_CYCLE]
            assert last == (known if stays(before[slot.name], slot) else -1)


def stays(was: RxSlot, slot: RxSlot) -> bool:
    return (was.publisher, was.step) == (slot.publisher, slot.step)


def limits_of(slot: RxSlot) -> tuple[object, ...]:
    return slot.publisher, slot.step, slot.sender_cycle_us, slot.timeout_ms


def test_trackers_that_have_parted_are_noticed():
    spec = station(
        variables=received("a:UINT", "b:UINT"),
        subscriptions=(
            RxPdSpec("a", "eap0", 1, ("a",), PEER),
            RxPdSpec("b", "eap0", 2, ("b",), PEER),
        ),
    )
    old, new = image_of(spec), image_of(spec)
    made = Station(spec, old, lambda: None)
    handover = ImageHandover(old, new)
    made.start(0)
    give(made.handlers["eap0"], octets([(1, b"\1\0"), (2, b"\2\0")], cycle=1), MS)
    assert handover.is_current
    give(made.handlers["eap0"], octets([(1, b"\3\0")], cycle=2), 2 * MS)
    assert not handover.is_current


def test_handover_keeps_learned_addresses():
    made, wire = assemble(addressed())
    made.start(0)
    take, frame = made.handlers["eap0"], octets([(9, b"\0\0")])
    take(memoryview(frame), len(frame), MS, From("02:00:00:00:00:07"))
    by_id, by_mac = made.spec.frames
    moved = msgspec.structs.replace(by_mac, destination="02:00:00:00:00:06")
    after = succeed(made, msgspec.structs.replace(made.spec, frames=(by_id, moved)))
    wire.sent.clear()
    after.cycle(2 * MS, 2 * MS)
    assert len(wire.sent) == 2
    addresses = [row["address"] for row in station_status(after.image, 0)["frames"]]
    assert addresses == ["02:00:00:00:00:07", "02:00:00:00:00:06"]

    take(memoryview(frame), len(frame), SECOND, From("02:00:00:00:00:08"))
    assert station_status(after.image, 0)["frames"][0]["address"] == "02:00:00:00:00:08"


def test_handover_of_frame_to_other_net_id_resets_address_and_presence():
    made, _ = assemble(addressed())
    made.start(0)
    frame = octets([(9, b"\0\0")])
    made.handlers["eap0"](memoryview(frame), len(frame), MS, From("02:00:00:00:00:07"))
    made.image.words[made.image.layout.frames[0].words + FrameWord.PRESENCE] = (
        SubscriberPresence.MISSING
    )
    by_id, by_mac = made.spec.frames
    moved = msgspec.structs.replace(by_id, destination=THIRD)
    after = succeed(made, msgspec.structs.replace(made.spec, frames=(moved, by_mac)))
    (row, _) = station_status(after.image, 0)["frames"]
    assert (row["address"], row["subscriber"]) == (None, "unknown")
    other = octets([(9, b"\0\0")], publisher=THIRD)
    after.handlers["eap0"](memoryview(other), len(other), MS, From("02:00:00:00:00:09"))
    assert station_status(after.image, 0)["frames"][0]["address"] == "02:00:00:00:00:09"

    after.image.words[after.image.layout.frames[0].words + FrameWord.PRESENCE] = (
        SubscriberPresence.MISSING
    )
    same = succeed(after, after.spec)
    assert station_status(same.image, 0)["frames"][0]["subscriber"] == "missing"
    watched = msgspec.structs.replace(moved, monitor_interval_ms=1000)
    after = succeed(same, msgspec.structs.replace(made.spec, frames=(watched, by_mac)))
    row = station_status(after.image, 0)["frames"][0]
    assert (row["address"], row["subscriber"]) == ("02:00:00:00:00:09", "unknown")

    empty = succeed(after, msgspec.structs.replace(made.spec, frames=()))
    empty.handlers["eap0"](memoryview(other), len(other), 2 * SECOND, From("02:00:00:00:00:0a"))
    assert station_status(empty.image, 0)["frames"] == []


def test_handover_continues_triggers():
    made, wire = assemble(moody())
    made.start(0)
    made.cycle(MS, MS)
    assert sent_ids(wire) == [1, 3]
    set_value(made.image, "event.VarCtrl", 2)
    made.cycle(2 * MS, 2 * MS)
    assert sent_ids(wire) == [2, 3]
    after = succeed_with_values(made, made.spec)
    after.cycle(3 * MS, 3 * MS)
    assert sent_ids(wire) == [3]  # neither the data nor the bit has changed
    set_value(after.image, "x", 5)
    after.cycle(4 * MS, 4 * MS)
    assert sent_ids(wire) == [1, 3]
    wire.refuse = True
    set_value(after.image, "event.VarCtrl", 0)
    after.cycle(5 * MS, 5 * MS)
    set_value(after.image, "event.VarCtrl", 2)
    after.cycle(6 * MS, 6 * MS)
    wire.refuse = False
    wire.sent.clear()
    last = succeed_with_values(after, after.spec)
    last.cycle(7 * MS, 7 * MS)
    assert sent_ids(wire) == [2, 3]  # the event that could not be sent


def test_a_pd_that_is_another_one_now_is_sent_though_its_data_is_the_same():
    made, wire = assemble(moody())
    made.start(0)
    made.cycle(MS, MS)
    first, second = made.spec.frames
    change, event = first.pds
    renewed = msgspec.structs.replace(change, version=9)
    frames = (msgspec.structs.replace(first, pds=(renewed, event)), second)
    wire.sent.clear()
    after = succeed_with_values(made, msgspec.structs.replace(made.spec, frames=frames))
    after.cycle(2 * MS, 2 * MS)
    assert sent_ids(wire) == [1, 3]


def test_a_question_is_answered_across_a_change():
    made, _ = assemble(moody())
    made.start(0)
    made.cycle(MS, MS)
    after = succeed_with_values(made, made.spec)
    give(after.handlers["eap0"], octets([(4, b"\1\0")], cycle=1), MS + 300_000)
    status = station_status(after.image, SECOND)["pd"]["rx"][0]
    assert (status["received"], status["response_us"]["max"]) == (1, 300)


def test_time_outs_go_on_and_new_ones_begin():
    made, wire = assemble(moody())
    made.start(0)
    wire.waiting.append((octets([(7, b"\5\0")], cycle=1), MS))
    made.cycle(MS, MS)
    after = succeed_with_values(made, made.spec, 2 * MS)
    after.cycle(3 * MS, 3 * MS)
    assert after.image.read("r") == 5
    after.cycle(5 * MS, 5 * MS)
    assert after.image.read("r") == 0
    answer, stale = made.spec.subscriptions
    without = msgspec.structs.replace(stale, timeout_ms=0, substitute=Substitute.HOLD)
    spec = msgspec.structs.replace(made.spec, subscriptions=(answer, without))
    last = succeed_with_values(after, spec, 5 * MS)
    last.cycle(SECOND, SECOND)
    assert station_status(last.image, SECOND)["pd"]["rx"][1]["timeouts"] == 1


def test_a_gap_at_a_change_of_rate_is_of_the_old_rate_or_the_new_and_no_loss():
    slow = RxPdSpec("r", "eap0", 9, ("x",), PEER, step=2, sender_cycle_us=1000)
    made, _ = assemble(station(variables=received("x:UINT"), subscriptions=(slow,)))
    made.start(0)
    take = made.handlers["eap0"]
    for cycle in (2, 4):
        frame = octets([(9, b"\0\0")], cycle=cycle)
        take(memoryview(frame), len(frame), cycle * MS, From(""))
    fast = msgspec.structs.replace(slow, step=1)
    after = succeed(made, msgspec.structs.replace(made.spec, subscriptions=(fast,)))
    for cycle in (6, 7, 9):  # the sender changed after its cycle 5; then one is lost
        frame = octets([(9, b"\0\0")], cycle=cycle)
        take(memoryview(frame), len(frame), cycle * MS, From(""))
    (row,) = station_status(after.image, 9 * MS)["pd"]["rx"]
    assert (row["received"], row["lost"]) == (5, 1)


def test_replaced_station_can_be_released():
    made, wire = assemble(moody())
    made.start(0)
    wire.waiting.append((octets([(7, b"\5\0")], cycle=1), MS))
    made.cycle(MS, MS)
    after = succeed_with_values(made, made.spec)
    made.release()
    assert made.image.slots == {}
    wire.sent.clear()
    wire.waiting.append((octets([(7, b"\6\0")], cycle=2), 2 * MS))
    after.cycle(2 * MS, 2 * MS)
    assert after.image.read("r") == 6
    assert sent_ids(wire) == [3]


END = ": restart the appliance"
BUS = PortSpec(
    "bus0",
    PortKind.BUS,
    InterfaceUri.parse("sim://x.yaml"),
    NetId.parse("1.2.3.4.6.1"),
    bus=BusPortSpec("/x.yaml"),
)


def test_all_but_ports_may_change():
    assert needs_new_start(left(), left()) == []
    assert needs_new_start(left(), replace(left(), frames=(), variables=(), cycle_us=7)) == []


def test_port_changes_ignore_frame_fields_of_port():
    port = replace(eap_port(1), net_id=NetId.parse("9.9.9.9.1.1"), eap_sm=True)
    assert not port_changes(left(), left(port))
    assert needs_new_start(left(), left(port)) == []


def test_port_changes_name_ports_that_come_and_go():
    first, second = eap_port(1), replace(eap_port(2), name="eap1")
    both = replace(left(), ports=(first, second))
    assert port_changes(left(), both) == PortChanges((), (second,))
    assert port_changes(both, left()) == PortChanges((second,), ())
    assert needs_new_start(left(), both) == []


def test_port_with_other_settings_goes_and_comes():
    moved = replace(eap_port(1), interface=InterfaceUri.parse("udp://127.9.2.9"))
    for port in (moved, replace(eap_port(1), join=("239.1.1.1",)), replace(eap_port(1), tcp=True)):
        assert port_changes(left(), left(port)) == PortChanges((eap_port(1),), (port,))
        assert needs_new_start(left(), left(port)) == []


def test_station_keeps_its_name():
    assert needs_new_start(left(), replace(left(), name="up")) == [
        f"station left cannot become up{END}"
    ]


def with_bus(**changes):
    return replace(left(), ports=(replace(BUS, bus=BusPortSpec("/x.yaml", **changes)),))


SYNCED = BusSlaveSpec("a", 1001, 1, 2, config=SlaveConfig(sync=OpMode()))


@pytest.mark.parametrize(
    ("before", "after", "cycle_us", "restarting"),
    [
        ({}, {}, 10_000, set()),
        ({}, {"target": BusTarget.PREOP}, 10_000, {"bus0"}),
        ({}, {"slaves": (BusSlaveSpec("a", 1001, 1, 2),)}, 10_000, {"bus0"}),
        ({}, {"redundant": "sim://x.yaml"}, 10_000, {"bus0"}),
        ({}, {}, 5_000, set()),
        ({"clocks": True}, {"clocks": True}, 5_000, {"bus0"}),
        ({"slaves": (SYNCED,)}, {"slaves": (SYNCED,)}, 5_000, {"bus0"}),
    ],
)
def test_bus_restarts_if_its_master_needs_other_settings(before, after, cycle_us, restarting):
    old = replace(with_bus(**before), cycle_us=10_000)
    new = replace(with_bus(**after), cycle_us=cycle_us)
    assert needs_new_start(old, new) == []
    assert restarting_buses(old, new) == restarting
    assert restarting_buses(replace(old, ports=()), new) == set()


def test_bus_does_not_restart_for_the_path_of_its_file():
    moved = replace(left(), ports=(replace(BUS, bus=BusPortSpec("/y.yaml")),))
    assert restarting_buses(with_bus(), moved) == set()


def test_members_of_a_changed_struct_keep_their_values():
    inner = "P<4/2:x@0 INT,y@2 INT>"
    before = f"S<16/8:a@0 INT,f@2.0 BIT,g@2.1 BIT,p@4 {inner},r@8 LREAL>"
    after = "S<24/8:n@0 INT,g@2.3 BIT,p@4 P<6/2:z@0 INT,y@2 INT,x@4 INT>,r@16 LREAL,a@12 DINT>"
    defaults = {"n": 9, "g": 0, "p": {"z": 8, "y": 0, "x": 0}, "r": 0.0, "a": 7}
    old = image_of(station(variables=(VariableSpec("v", before),)))
    new = image_of(station(variables=(VariableSpec("v", after, default=defaults),)))
    old.write("v", {"a": 5, "f": 1, "g": 1, "p": {"x": 3, "y": 4}, "r": 2.5})
    handover = ImageHandover(old, new)
    handover.carry_values(old.memory)
    # Of another type, or new: as the default.
    assert new.read("v") == {"n": 9, "g": 1, "p": {"z": 8, "y": 4, "x": 3}, "r": 2.5, "a": 7}
