from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.codec.pd import iter_pds
from eap.ids import NetId
from eap.pd.image import Image, Inputs
from eap.pd.spec import (
    OnChangeSpec,
    RxPdSpec,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.trigger import Trigger, plan_schedule
from eap.pd.txframe import Gather, TxFrame, TxPd
from tests.support.cyclic import PEER, Receiver, Wire, image_of, octets, station, written

NAMES = ("a", "b", "c")


def build(*triggers: TriggerSpec, gate=(0, 0), wire: Wire | None = None) -> tuple[TxFrame, Image]:
    pds = tuple(
        TxPdSpec(f"p{i}", i, (NAMES[i % 3],), version=i, trigger=trigger)
        for i, trigger in enumerate(triggers, 1)
    )
    spec = station(
        variables=written("a:UINT", "b:USINT", "c:BOOL"),
        frames=(TxFrameSpec("f", "eap0", "10.0.0.9", pds, *gate),),
    )
    image = image_of(spec)
    inputs = Inputs(image)
    run_time = tuple(
        TxPd(
            slot,
            Trigger(pd.trigger, plan_schedule(pd.trigger, 1000, gate)),
            Gather(image, inputs, pd.variables),
        )
        for pd, slot in zip(pds, image.layout.tx, strict=True)
    )
    slot = image.layout.frames[0]
    return TxFrame(slot, NetId.parse(PEER), run_time, gate, wire or Wire(), "10.0.0.9"), image


def ids(selection) -> list[int]:
    return [pd.pd_id for pd, _ in iter_pds(selection.out.view[selection.out.headroom :])]


def test_a_frame_is_built_once_and_patched_with_counter_and_data():
    frame, image = build(TriggerSpec(), TriggerSpec())
    frame.whole.patch(0x1_0005)
    before = frame.whole.out.buffer
    rows = [(pd.pd_id, pd.version, bytes(data)) for pd, data in iter_pds(before)]
    assert rows == [(1, 1, b"\0"), (2, 2, b"\0")]
    assert bytes(before[10:12]) == b"\x05\0"
    assert bytes(before[2:8]) == NetId.parse(PEER)
    assert frame.whole.out.destination == "10.0.0.9"
    del image
    assert frame.whole.out.buffer is before


def test_the_channel_decides_what_stands_before_and_behind():
    frame, _ = build(TriggerSpec(), wire=Wire(header=b"\xaa" * 14, minimum_size=60))
    out = frame.whole.out
    frame.whole.patch(3)
    assert (out.headroom, len(out.buffer)) == (14, 60)
    assert bytes(out.buffer[:14]) == b"\xaa" * 14
    assert out.buffer[14 + 10] == 3
    assert not any(out.buffer[14 + 2 + 12 + 8 + 1 :])


def test_pds_of_one_clock_go_as_a_whole():
    assert build(TriggerSpec(), TriggerSpec())[0].is_plain
    assert build(TriggerSpec(), gate=(3, 1))[0].schedule[:2] == (3, 1)
    assert not build(TriggerSpec(), TriggerSpec(cycle_us=2000))[0].is_plain
    assert not build(TriggerSpec(event=True))[0].is_plain
    assert not build(TriggerSpec(cycle_us=1000, event=True))[0].is_plain


def test_each_pd_is_due_on_its_own_clock():
    frame, _ = build(TriggerSpec(), TriggerSpec(cycle_us=2000), TriggerSpec(divider=3, modulo=1))
    seen = []
    for cycle in range(1, 5):
        selection, skipped = frame.select(cycle, 0)
        assert skipped == []
        seen.append(ids(selection))
    assert seen == [[1, 3], [1, 2], [1], [1, 2, 3]]


def test_the_gate_comes_before_everything():
    frame, _ = build(TriggerSpec(on_change=OnChangeSpec()), gate=(2, 1))
    assert frame.select(2, 0) == (None, [])
    selection, _ = frame.select(3, 0)
    assert ids(selection) == [1]


def test_what_is_suppressed_is_skipped_and_the_rest_goes():
    frame, _ = build(TriggerSpec(), TriggerSpec())
    frame.pds[0].trigger.suppressed = True
    assert not frame.is_plain
    selection, skipped = frame.select(1, 0)
    assert (ids(selection), skipped) == ([2], [frame.pds[0]])
    frame.suppressed = True
    assert frame.select(2, 0) == (None, list(frame.pds))


def test_a_selection_is_kept_but_not_without_limit():
    frame, _ = build(*[TriggerSpec()] * 8)
    for pd in frame.pds:
        pd.trigger.suppressed = False
    frame.pds[0].trigger.suppressed = True
    first, _ = frame.select(1, 0)
    assert frame.select(2, 0)[0] is first
    for mask in range(1, 255):
        for bit, pd in enumerate(frame.pds):
            pd.trigger.suppressed = bool(mask >> bit & 1)
        selection, _ = frame.select(3, 0)
        assert ids(selection) == [bit + 1 for bit in range(8) if not mask >> bit & 1]
        assert len(frame._selections) <= 64


def test_retargeted_frame_is_built_anew_for_its_new_destination():
    frame, _ = build(TriggerSpec(), TriggerSpec())
    before = frame.whole.out
    frame.retarget("10.0.0.10")
    frame.whole.patch(7)
    assert (before.destination, frame.whole.out.destination) == ("10.0.0.9", "10.0.0.10")
    assert ids(frame.whole) == [1, 2]
    assert frame.select(1, 0)[0] is frame.whole


def test_frame_without_an_address_is_held_and_says_what_was_due():
    frame, _ = build(TriggerSpec(), TriggerSpec(divider=2))
    frame.retarget("")
    assert frame.is_held
    assert not frame.is_plain
    chosen, held = frame.select(1, 0)
    assert chosen is None
    assert [pd.slot.name for pd in held] == ["p1"]
    frame.retarget("10.0.0.9")
    assert not frame.is_held


KINDS = ["BOOL", "BIT3", "BIT7", "BIT8", "USINT", "UINT24", "LREAL", "INT[2]", "BLOCK(3)"]


def collect(image: Image, inputs: Inputs, names: list[str], offset: int = 0) -> bytes:
    gather = Gather(image, inputs, names)
    buffer = bytearray(b"\xff" * (offset + gather.size))
    gather.into(memoryview(buffer), offset)
    assert buffer[:offset] == b"\xff" * offset
    return bytes(buffer[offset:])


@given(st.data())
def test_the_data_are_the_variables_in_pdo_order(data):
    kinds = data.draw(st.lists(st.sampled_from(KINDS), min_size=1, max_size=8))
    types = [datatypes.parse(kind) for kind in kinds]
    variables = tuple(
        VariableSpec(f"v{i}", kind, data.draw(st.sampled_from(Writer)))
        for i, kind in enumerate(kinds)
    )
    image = image_of(station(variables=variables))
    values = [kind.decode(data.draw(st.binary(min_size=16, max_size=16)), 0) for kind in types]
    for variable, value in zip(variables, values, strict=True):
        image.write(variable.name, value)
    order = data.draw(st.lists(st.integers(0, len(kinds) - 1), min_size=1, max_size=10))
    whole = collect(image, Inputs(image), [f"v{i}" for i in order], data.draw(st.integers(0, 20)))
    layout = datatypes.layout([types[i] for i in order])
    assert len(whole) == layout.size
    bits = int.from_bytes(whole, "little")
    end = 0
    for i, offset in zip(order, layout.bit_offsets, strict=True):
        assert not bits >> end & (1 << offset - end) - 1, "bits between variables are zero"
        end = offset + types[i].bit_length
        field = bits >> offset & (1 << types[i].bit_length) - 1
        field_octets = field.to_bytes(types[i].size, "little")
        assert field_octets == types[i].encode(values[i])
    assert not bits >> end


def test_neighbours_are_copied_in_one_piece():
    variables = tuple(VariableSpec(name, "UINT") for name in ("a", "b", "c"))
    image = image_of(station(variables=variables))
    gather = Gather(image, Inputs(image), ["a", "b", "c"])
    assert [where for where, _ in gather.copies(10)] == [slice(10, 16)]
    assert not gather.has_bits
    assert len(Gather(image, Inputs(image), ["b", "a"]).copies(0)) == 2


def test_the_engines_variables_are_live_and_all_others_are_those_of_the_cycle():
    variables = (VariableSpec("own", "UINT", Writer.ENGINE), VariableSpec("app", "UINT"))
    image = image_of(station(variables=variables))
    inputs = Inputs(image)
    image.write("own", 1)
    image.write("app", 2)
    assert collect(image, inputs, ["own", "app"]) == b"\1\0\0\0"


@pytest.mark.parametrize("bits", [0b0101, 0b1010])
def test_received_bits_are_forwarded_from_where_they_were_packed(bits):
    r = Receiver(
        RxPdSpec("r", "eap0", 1, ("a", "b", "c")),
        variables=tuple(
            VariableSpec(name, kind, Writer.ENGINE)
            for name, kind in (("a", "BOOL"), ("b", "BIT2"), ("c", "BOOL"))
        ),
    )
    r.give(octets([(1, bytes([bits]))]), 0)
    inputs = Inputs(r.image)
    assert collect(r.image, inputs, ["a", "b", "c"]) == bytes([bits])
    assert collect(r.image, inputs, ["c", "b"]) == bytes([bits >> 3 | (bits >> 1 & 3) << 1])
