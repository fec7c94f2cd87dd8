from __future__ import annotations

from eap.codec.pd import iter_pds
from eap.ids import NetId
from eap.pd.image import Image, Inputs
from eap.pd.spec import OnChangeSpec, TriggerSpec, TxFrameSpec, TxPdSpec
from eap.pd.trigger import Trigger, plan_schedule
from eap.pd.txframe import Gather, TxFrame, TxPd
from tests.support.cyclic import PEER, Wire, image_of, station, written

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
            place,
            Trigger(pd.trigger, plan_schedule(pd.trigger, 1000, gate)),
            Gather(image, inputs, pd.variables),
        )
        for pd, place in zip(pds, image.layout.tx, strict=True)
    )
    place = image.layout.frames[0]
    return TxFrame(place, NetId.parse(PEER), run_time, gate, wire or Wire(), "10.0.0.9"), image


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
    assert [pd.place.name for pd in held] == ["p1"]
    frame.retarget("10.0.0.9")
    assert not frame.is_held
