from __future__ import annotations

import re
from collections.abc import Mapping

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.codec.pd import PdHeader
from eap.ids import InterfaceUri
from eap.net.loopback import LoopbackLines
from eap.pd.layout import (
    FRAME_CTRL,
    VAR_CTRL,
    WORDS_OFFSET,
    AlternateSlot,
    ImageLayout,
    RxSlot,
    mirror,
    plan_layout,
)
from eap.pd.report import station_status
from eap.pd.spec import (
    BusEntrySpec,
    CounterSource,
    RxAlternateSpec,
    RxPdSpec,
    SentVariableSpec,
    StationSpec,
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
    bus_port,
    eap_port,
    entries,
    image_of,
    received,
    slave,
    station,
    written,
)

TYPES = st.sampled_from(["BOOL", "BIT3", "USINT", "UINT24", "LREAL", "STRING(5)", "INT[3]"])


def test_received_pds_follow_each_other_as_in_a_frame_header_included():
    layout = plan_layout(
        station(
            variables=received("a:UINT", "b:BOOL", "c:BIT3", "d:UDINT"),
            subscriptions=(
                RxPdSpec("r1", "eap0", 1, ("a", "b", "c")),
                RxPdSpec("r2", "eap0", 2, ("d",)),
            ),
        )
    )
    first, second = layout.rx
    assert (first.size, second.size) == (3, 4)
    assert second.offset == first.offset + 8 + first.size
    bits = {slot.name: slot.bit_offset - 8 * (first.offset + 8) for slot in layout.variables}
    assert bits == {"a": 0, "b": 16, "c": 17, "d": 8 * (3 + 8)}


def test_every_frame_and_pd_of_a_station_gets_a_control_variable():
    layout = plan_layout(
        station(
            variables=written("x:UINT"),
            frames=(TxFrameSpec("f", "eap0", "10.0.0.1", (TxPdSpec("p", 1, ("x",)),)),),
        )
    )
    controls = {slot.name: slot for slot in layout.variables if "Ctrl" in slot.name}
    assert set(controls) == {"f" + FRAME_CTRL, "p" + VAR_CTRL}
    assert all(slot.writer is Writer.APPLICATION for slot in controls.values())


def test_tx_slot_by_schedule_is_false_with_other_triggers():
    triggers = {
        "each": TriggerSpec(),
        "cyclic": TriggerSpec(cycle_us=2000),
        "divided": TriggerSpec(divider=2),
        "event": TriggerSpec(cycle_us=2000, event=True),
    }
    layout = plan_layout(
        station(
            variables=written("x:UINT"),
            frames=(
                TxFrameSpec(
                    "f",
                    "eap0",
                    "10.0.0.1",
                    tuple(
                        TxPdSpec(n, i, ("x",), trigger=t)
                        for i, (n, t) in enumerate(triggers.items())
                    ),
                ),
                TxFrameSpec("g", "eap0", "10.0.0.1", (TxPdSpec("gated", 9, ("x",)),), divider=2),
            ),
        )
    )
    assert {slot.name: (slot.by_schedule, slot.cyclic) for slot in layout.tx} == {
        "each": (True, True),
        "cyclic": (True, True),
        "divided": (True, False),
        "event": (False, True),
        "gated": (True, False),
    }


@given(
    st.lists(TYPES, min_size=1, max_size=6),
    st.lists(st.tuples(st.sampled_from(Writer), TYPES), max_size=6),
)
def test_places_of_variables_do_not_overlap(pd_types, others):
    variables = received(*(f"r{i}:{kind}" for i, kind in enumerate(pd_types)))
    names = tuple(variable.name for variable in variables)
    for i, (writer, kind) in enumerate(others):
        (variable,) = written(f"v{i}:{kind}")
        variables += (msgspec.structs.replace(variable, writer=writer),)
    sent = tuple(f"v{i}" for i in range(len(others)))
    frames = (TxFrameSpec("f", "eap0", "10.0.0.1", (TxPdSpec("p", 1, sent),)),) if sent else ()
    layout = plan_layout(
        station(
            variables=variables,
            subscriptions=(
                RxPdSpec("r", "eap0", 1, names[: len(names) // 2]),
                RxPdSpec("s", "eap0", 2, names[len(names) // 2 :]),
            ),
            frames=frames,
        )
    )
    bits: set[int] = set()
    for slot in layout.variables:
        region = layout.regions[slot.writer]
        length = datatypes.parse(slot.type).bit_length
        own = set(range(slot.bit_offset, slot.bit_offset + length))
        assert own.isdisjoint(bits)
        assert 8 * region.offset <= min(own) <= max(own) < 8 * (region.offset + region.size)
        bits |= own
    assert min(bits) >= 8 * (WORDS_OFFSET + 8 * layout.word_count)
    assert max(bits) < 8 * layout.directory_offset
    blocks = [(0, StationWord.SIZE)]
    blocks += [(slot.words, FrameWord.SIZE) for slot in layout.frames]
    blocks += [(slot.words, TxWord.SIZE) for slot in layout.tx]
    blocks += [(slot.words, RxWord.SIZE) for slot in layout.rx]
    words = [word for first, size in blocks for word in range(first, first + size)]
    assert sorted(words) == list(range(layout.word_count))


def test_the_directory_is_the_layout():
    layout = plan_layout(
        station(variables=received("a:UINT"), subscriptions=(RxPdSpec("r", "eap0", 1, ("a",)),))
    )
    assert msgspec.json.decode(layout.encode(), type=ImageLayout) == layout
    assert layout.size == layout.directory_offset + len(layout.encode())


def test_slaves_lie_in_the_image_as_in_their_process_data():
    inputs = [entries("a:1", "b:1", ":6", "c:16"), entries("d:4", ":4"), entries("e:8")]
    layout = plan_layout(
        station(
            ports=(
                eap_port(),
                bus_port(slave(inputs[0]), slave(station=1002), slave(inputs[1], station=1003)),
                bus_port(slave(inputs[2]), name="bus1"),
            ),
            variables=received(
                "r:UINT", "state:BYTE", "e:USINT", "d:BIT4", "c:INT", "b:BOOL", "a:BOOL"
            ),
            subscriptions=(RxPdSpec("r", "eap0", 1, ("r",)),),
        )
    )
    bits = {slot.name: slot.bit_offset for slot in layout.variables}
    first = bits["r"] + 16
    assert bits["state"] == first + 40
    assert {name: bits[name] - first for name in "abcde"} == {
        "a": 0, "b": 1, "c": 8, "d": 24, "e": 32,
    }  # fmt: skip
    assert layout.regions[Writer.ENGINE].size == 8 + 2 + 5 + 1


def test_each_writer_of_a_slaves_outputs_has_a_mirror_of_them():
    outputs = entries("a:1", "b:1", ":6", "c:16")
    layout = plan_layout(
        station(
            ports=(eap_port(), bus_port(slave(outputs=outputs), slave(entries("i:8"), outputs=()))),
            variables=(*written("x:UINT", "b:BOOL"), *received("a:BOOL", "c:INT", "i:USINT")),
        )
    )
    bits = {slot.name: slot.bit_offset for slot in layout.variables}
    engine, application = (
        layout.regions[w].offset * 8 for w in (Writer.ENGINE, Writer.APPLICATION)
    )
    # Inputs first, then what the engine writes of the outputs.
    assert [bits[name] - engine for name in "iac"] == [0, 8, 16]
    assert [bits[name] - application for name in "bx"] == [1, 24]


def test_a_bus_without_a_description_has_no_variables():
    assert plan_layout(station(ports=(bus_port(),))).variables == ()


ALTERNATE_TYPES = ("BOOL", "BIT3", "BIT8", "USINT", "UINT24", "LREAL", "STRING(3)", "INT[2]")


def alternate(version: int, *variables: str) -> RxAlternateSpec:
    """Another layout, its variables written as ``name:type``."""
    rows = (SentVariableSpec(*variable.split(":", 1)) for variable in variables)
    return RxAlternateSpec(version, tuple(rows))


def slots(*alternates: RxAlternateSpec) -> RxSlot:
    """The place of an RxPD of version 1, with a UINT and a BOOL, behind another one."""
    pds = (
        RxPdSpec("first", "eap0", 1, ("x",)),
        RxPdSpec("r", "eap0", 2, ("n", "on"), version=1, alternates=alternates),
    )
    variables = received("x:UINT", "n:UINT", "on:BOOL")
    return plan_layout(station(variables=variables, subscriptions=pds)).rx[1]


def test_without_alternates_there_are_no_slots():
    assert slots().alternates == ()


def test_alternate_slot_has_moves_and_untouched_variables():
    slot = slots(alternate(0, "on:BOOL", ":REAL"), alternate(2, ":BIT3", "n:uint16"))
    data = 8 * (slot.offset + 8)
    quality = (48, data - 16, 16)
    assert slot.alternates == (
        AlternateSlot(0, 5, (quality, (64, data + 16, 1)), ((data, 16),)),
        AlternateSlot(2, 3, (quality, (72, data, 16)), ((data + 16, 1),)),
    )


@pytest.mark.parametrize(
    ("alternates", "told"),
    [
        ([alternate(2, "m:UINT")],
         "of version 2 of RxPD 'r' brings m (UINT), expected each of n (UINT), on (BOOL) at most"),
        ([alternate(2, "x:UINT")], "brings x (UINT)"),
        ([alternate(2, "n:INT")], "brings n (INT)"),
        ([alternate(2, "on:BOOL", "on:BOOL")], "brings on (BOOL)"),
        ([alternate(1, "on:BOOL", ":UINT")],
         "has 3 bytes like another layout of that version, expected another version"),
        ([alternate(2, "n:UINT"), alternate(2, ":INT")], "has 2 bytes like another"),
        ([alternate(2, "n:FOO")], "'FOO' is not a data type"),
    ],
)  # fmt: skip
def test_alternate_with_foreign_variable_is_rejected(alternates, told):
    with pytest.raises(ValueError, match=re.escape(told)):
        slots(*alternates)


def test_one_version_can_have_several_sizes():
    sizes = [each.size for each in slots(alternate(1, "n:UINT"), alternate(1, ":LREAL")).alternates]
    assert sizes == [2, 8]


variables = st.lists(st.sampled_from(ALTERNATE_TYPES), min_size=1, max_size=8)


@st.composite
def layouts(draw: st.DrawFn) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Variables of an RxPD, and of an alternate, by name and type."""
    own = [(f"v{number}", kind) for number, kind in enumerate(draw(variables))]
    kept = draw(st.sets(st.sampled_from(own)))
    others = [("", kind) for kind in draw(st.lists(st.sampled_from(ALTERNATE_TYPES), max_size=4))]
    return own, draw(st.permutations([*kept, *others]))


def bits(buffer: bytes, first: int, count: int) -> int:
    return int.from_bytes(buffer, "little") >> first & (1 << count) - 1


@given(layouts(), st.randoms())
def test_alternate_copies_its_variables_only(pair, random):
    own, brought = pair
    pd = RxPdSpec(
        "r", "eap0", 1, tuple(name for name, _ in own),
        alternates=(alternate(1, *(f"{name}:{kind}" for name, kind in brought)),),
    )  # fmt: skip
    variables = received(*(f"{name}:{kind}" for name, kind in own), "after:UINT")
    image = image_of(station(variables=variables, subscriptions=(pd,)))
    slot = image.layout.rx[0]
    first, end = slot.offset, slot.offset + PdHeader.SIZE + slot.size
    image.memory[first:end] = random.randbytes(end - first)
    before = bytes(image.memory)

    plan = datatypes.layout([datatypes.parse(kind) for _, kind in brought])
    sent = random.randbytes(PdHeader.SIZE + plan.size)
    slot.alternates[0].copy_plan().run(sent, image.memory)

    came = {name: 64 + bit for (name, _), bit in zip(brought, plan.bit_offsets, strict=True)}
    for name, kind in own:
        where, count = image.slots[name].bit_offset, datatypes.parse(kind).bit_length
        source = (sent, came[name]) if name in came else (before, where)
        assert bits(bytes(image.memory), where, count) == bits(*source, count)
    assert image.memory[first : first + 6] == before[first : first + 6]
    assert image.memory[first + 6 : first + 8] == sent[6:8]
    assert image.memory[end:] == before[end:]
    assert image.memory[:first] == before[:first]


OLD = {"n": "UDINT", "on": "BOOL", "gone": "UINT"}
NEW = {"added": "LREAL", "open": "BIT3", "on": "BOOL", "n": "UDINT"}


def sender(version: int, layout: Mapping[str, str]) -> StationSpec:
    """Sends a counter and more, laid out as *layout*, between two PDs that never change."""
    variables = {"steady": "UINT"} | layout
    pds = (
        TxPdSpec("before", 6, ("steady",)),
        TxPdSpec("changing", 7, tuple(layout), version),
        TxPdSpec("behind", 8, ("steady",)),
    )
    return station(
        "sender",
        ports=(eap_port("eap0", PEER),),
        variables=tuple(
            VariableSpec(name, kind, Writer.ENGINE if name == "n" else Writer.APPLICATION)
            for name, kind in variables.items()
        ),
        sources=(CounterSource("n"),),
        frames=(TxFrameSpec("f", "eap0", "10.0.0.1", pds),),
    )


def handler(version: int, layout: Mapping[str, str], other: RxAlternateSpec) -> StationSpec:
    """Takes what :func:`sender` sends, and *other* as well."""
    pace = {"publisher": PEER, "step": 1, "sender_cycle_us": 1000, "timeout_ms": 3}
    return station(
        "taker",
        phase_us=500,
        variables=received("x:UINT", *(f"r.{n}:{kind}" for n, kind in layout.items()), "y:UINT"),
        subscriptions=(
            RxPdSpec("before", "eap0", 6, ("x",), **pace),
            RxPdSpec("changing", "eap0", 7, tuple(f"r.{name}" for name in layout),
                     version=version, alternates=(other,), **pace),
            RxPdSpec("behind", "eap0", 8, ("y",), **pace),
        ),
    )  # fmt: skip


def other_than(own: Mapping[str, str], version: int, layout: Mapping[str, str]) -> RxAlternateSpec:
    rows = (f"{f'r.{name}' if name in own else ''}:{kind}" for name, kind in layout.items())
    return alternate(version, *rows)


@pytest.mark.parametrize(
    ("old_version", "new_version", "new"),
    [(1, 2, NEW), (1, 1, NEW), (1, 2, OLD), (1, 2, {"gone": "UINT", "on": "BOOL", "n": "UDINT"})],
)
@pytest.mark.parametrize("takes_new_first", [True, False])
def test_a_sender_that_changes_over_in_the_middle_of_a_run_is_followed(
    old_version, new_version, new, takes_new_first
):
    own, other = ((new_version, new), (old_version, OLD))[:: 1 if takes_new_first else -1]
    spec = handler(*own, other_than(own[1], *other))
    lines = LoopbackLines()
    channels = [lines.open(InterfaceUri.parse("loop://line")) for _ in range(2)]
    receiving, sending = Station(spec, image_of(spec), lambda: None), None
    channels[1].handlers.append(receiving.handlers["eap0"])
    receiving.connect("eap0", channels[1])
    receiving.start(0)
    now = 0
    for version, layout in ((old_version, OLD), (new_version, new)):
        sent = sender(version, layout)
        following = Station(sent, image_of(sent), lambda: None)
        following.connect("eap0", channels[0])
        if sending is not None:  # as the engine does: the counters go on
            following.image.words[StationWord.CYCLE] = sending.image.words[StationWord.CYCLE]
            following.image.write("n", sending.image.read("n"))
        following.start(now)
        for name in ("on", "steady"):
            following.image.write(name, 1)
        sending = following
        for _ in range(20):
            now += MS
            sending.cycle(now, now)
            receiving.cycle(now + MS // 2, now + MS // 2)
            assert receiving.image.read("r.n") == sending.image.read("n")
    assert (receiving.image.read("r.on"), receiving.image.read("y")) == (True, 1)
    status = station_status(receiving.image, now + MS // 2)
    assert status["discarded"] == {}
    for row in status["pd"]["rx"]:
        assert (row["received"], row["lost"], row["duplicated"], row["late"]) == (40, 0, 0, 0)
        assert (row["state"], row["timeouts"], row["var_state"]) == ("running", 0, 0)
    firsts = {receiving.image.words[slot.words] for slot in receiving.image.layout.rx}
    assert len(firsts) == 1, "the tracker is shared as before"


BUS_TYPES = {name: datatypes.parse(name) for name in ("BOOL", "BIT3", "UINT", "USINT")}


def bus_entries(*rows: tuple[str, int]) -> list[BusEntrySpec]:
    """Variables called like their types, each with its bits; without a name it is padding."""
    return [BusEntrySpec(name, 0x6000, at, bits) for at, (name, bits) in enumerate(rows, 1)]


def test_bits_and_padding_keep_their_slots():
    plan = mirror(bus_entries(("BOOL", 1), ("", 2), ("BIT3", 3), ("", 10), ("UINT", 16)), BUS_TYPES)
    assert plan.bit_offsets == {"BOOL": 0, "BIT3": 3, "UINT": 16}
    assert plan.size == 4


def test_a_number_in_the_middle_of_an_octet_moves_to_the_next():
    plan = mirror(bus_entries(("BOOL", 1), ("UINT", 16), ("BIT3", 3), ("USINT", 8)), BUS_TYPES)
    assert plan.bit_offsets == {"BOOL": 0, "UINT": 8, "BIT3": 24, "USINT": 32}
    assert plan.size == 5


def test_the_last_octet_is_taken_as_a_whole():
    assert mirror(bus_entries(("BOOL", 1)), BUS_TYPES).size == 1
    assert mirror([], BUS_TYPES).size == 0
