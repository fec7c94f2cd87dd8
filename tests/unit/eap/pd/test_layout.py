from __future__ import annotations

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.pd.layout import FRAME_CTRL, VAR_CTRL, WORDS_OFFSET, ImageLayout, plan_layout
from eap.pd.spec import RxPdSpec, TriggerSpec, TxFrameSpec, TxPdSpec, Writer
from eap.pd.words import FrameWord, RxWord, StationWord, TxWord
from tests.support.cyclic import bus_port, eap_port, entries, received, slave, station, written

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
    bits = {place.name: place.bit_offset - 8 * (first.offset + 8) for place in layout.variables}
    assert bits == {"a": 0, "b": 16, "c": 17, "d": 8 * (3 + 8)}


def test_every_frame_and_pd_of_a_station_gets_a_control_variable():
    layout = plan_layout(
        station(
            variables=written("x:UINT"),
            frames=(TxFrameSpec("f", "eap0", "10.0.0.1", (TxPdSpec("p", 1, ("x",)),)),),
        )
    )
    controls = {place.name: place for place in layout.variables if "Ctrl" in place.name}
    assert set(controls) == {"f" + FRAME_CTRL, "p" + VAR_CTRL}
    assert all(place.writer is Writer.APPLICATION for place in controls.values())


def test_a_tx_place_knows_whether_the_clock_alone_sends_it():
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
    assert {place.name: (place.by_schedule, place.cyclic) for place in layout.tx} == {
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
def test_nothing_overlaps(pd_types, others):
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
    for place in layout.variables:
        region = layout.regions[place.writer]
        length = datatypes.parse(place.type).bit_length
        own = set(range(place.bit_offset, place.bit_offset + length))
        assert own.isdisjoint(bits)
        assert 8 * region.offset <= min(own) <= max(own) < 8 * (region.offset + region.size)
        bits |= own
    assert min(bits) >= 8 * (WORDS_OFFSET + 8 * layout.word_count)
    assert max(bits) < 8 * layout.directory_offset
    blocks = [(0, StationWord.SIZE)]
    blocks += [(place.words, FrameWord.SIZE) for place in layout.frames]
    blocks += [(place.words, TxWord.SIZE) for place in layout.tx]
    blocks += [(place.words, RxWord.SIZE) for place in layout.rx]
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
    bits = {place.name: place.bit_offset for place in layout.variables}
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
    bits = {place.name: place.bit_offset for place in layout.variables}
    engine, application = (
        layout.regions[w].offset * 8 for w in (Writer.ENGINE, Writer.APPLICATION)
    )
    # Inputs first, then what the engine writes of the outputs.
    assert [bits[name] - engine for name in "iac"] == [0, 8, 16]
    assert [bits[name] - application for name in "bx"] == [1, 24]


def test_a_bus_without_a_description_has_no_variables():
    assert plan_layout(station(ports=(bus_port(),))).variables == ()
