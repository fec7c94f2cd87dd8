from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.codec.pd import iter_pds
from eap.ids import NetId
from eap.pd.image import Image, Inputs
from eap.pd.layout import VAR_CTRL
from eap.pd.report import station_status
from eap.pd.spec import (
    OnChangeSpec,
    RxPdSpec,
    StationSpec,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.station import Station
from eap.pd.txframe import EVENT_BIT, Gather, Schedule, Trigger, TxFrame, TxPd, plan_schedule
from eap.pd.words import REASON_INDEX, Reason
from eap.runtime.plantfile import load_plant
from tests.support.cyclic import MS, PEER, Receiver, Wire, image_of, octets, station, written

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


def test_tx_frame_has_headroom_and_padding_of_channel():
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


def test_tx_frame_skips_suppressed_pds_and_sends_the_rest():
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


def test_tx_frame_retarget_rebuilds_buffers():
    frame, _ = build(TriggerSpec(), TriggerSpec())
    before = frame.whole.out
    frame.retarget("10.0.0.10")
    frame.whole.patch(7)
    assert (before.destination, frame.whole.out.destination) == ("10.0.0.9", "10.0.0.10")
    assert ids(frame.whole) == [1, 2]
    assert frame.select(1, 0)[0] is frame.whole


def test_tx_frame_without_address_is_held_and_reports_due_pds():
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


DOCUMENT = Path(__file__).parents[4] / "docs" / "triggers.md"
KEYS = ("cycle_us", "divider", "on_change", "event", "frame divider")
VALUES = {
    "cycle_us": "cycle_us: 6000",
    "divider": "divider: 6\n        modulo: 3",
    "on_change": "on_change: {timeout_ms: 40, inhibit_us: 0}",
    "event": "event: true",
    "frame divider": "divider: 3",
}


def rows() -> list[tuple[str, ...]]:
    """Return the rows of the table of combinations as texts."""
    lines = DOCUMENT.read_text().splitlines()
    cells = [tuple(cell.strip() for cell in line.split("|")[1:-1]) for line in lines]
    return [row for row in cells if len(row) == 8 and row[0].isdecimal()]


def combinations(row: tuple[str, ...]) -> list[dict[str, bool]]:
    """Return which keys are given in *row*; "any" is both."""
    found: list[dict[str, bool]] = [{}]
    for key, cell in zip(KEYS, row[1:6], strict=True):
        choices = {"": (False,), "yes": (True,), "any": (False, True)}[cell]
        found = [one | {key: choice} for one in found for choice in choices]
    return found


def plant(given: dict[str, bool], values: dict[str, str] = VALUES) -> str:
    pd = "".join(f"        {values[key]}\n" for key in KEYS[:4] if given[key])
    gate = f"        {values['frame divider']}\n" if given["frame divider"] else ""
    return f"""\
plant: triggers
stations:
  - name: a
    net_id: 5.1.1.1.1.1
    cycle_us: 1000
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.0.5.1", net_id: 5.1.1.1.2.1}}
    variables: {{x: UINT}}
    frames:
      - name: f
        port: eap0
        to: 239.1.2.3
{gate}    publish:
      - name: p
        frame: f
        id: 1
        variables: [x]
{pd}"""


def read(tmp_path: Path, text: str) -> tuple[StationSpec | None, list[str]]:
    path = tmp_path / "plant.yaml"
    path.write_text(text)
    result = load_plant(path)
    station = result.plant.stations[0] if result.plant else None
    return station, [finding.message for finding in result.findings]


class Line:
    """A station run cycle by cycle, its PD's counters seen through the report."""

    def __init__(self, spec: StationSpec) -> None:
        self.image = image_of(spec)
        self.wire = Wire()
        self.station = Station(spec, self.image, lambda: None)
        self.station.connect("eap0", self.wire)
        self.due = self.station.start(0)
        self.cycle = 0

    def put(self, **values: int) -> None:
        with self.image.writing("application"):
            for name, value in values.items():
                self.image.write(name.replace("_", "."), value)

    def run(self, cycles: int = 1) -> dict[int, str]:
        """Return the reason of each cycle in which the PD was sent."""
        sent = {}
        for _ in range(cycles):
            self.cycle += 1
            before = self.tx["reason"]
            frames = len(self.wire.sent)
            self.station.cycle(self.due, self.due)
            self.due += MS
            after = self.tx["reason"]
            reasons = [why for why in after if after[why] != before.get(why, 0)]
            assert len(reasons) == len(self.wire.sent) - frames <= 1
            if reasons:
                sent[self.cycle] = reasons[0]
                assert self.tx["last_reason"] == reasons[0]
        return sent

    @property
    def tx(self) -> dict:
        return station_status(self.image, 0)["pd"]["tx"][0]


def test_the_table_has_every_combination_once():
    seen = [tuple(one.values()) for row in rows() for one in combinations(row)]
    refused = [row for row in rows() if row[6].startswith("*refused*")]
    assert len(seen) == len(set(seen)) == 32
    assert [row[0] for row in refused] == ["17", "18", "19"]


@pytest.mark.parametrize("row", rows(), ids=lambda row: row[0])
def test_a_row_is_refused_at_load_or_sends_for_its_reasons(row, tmp_path):
    for keys in combinations(row):
        spec, findings = read(tmp_path, plant(keys))
        if row[6].startswith("*refused*"):
            assert spec is None
            assert findings
            continue
        assert spec is not None, findings
        line = Line(spec)
        expected = predicted(keys)
        line.put(x=1)
        seen = line.run(14)
        line.put(x=2, p_VarCtrl=EVENT_BIT)
        seen |= line.run(10)
        line.put(x=3, p_VarCtrl=0)
        seen |= line.run(60)
        assert seen == expected
        named = {why.strip() for why in row[7].split(",")}
        assert set(seen.values()) == named


def predicted(given: dict[str, bool]) -> dict[int, str]:
    """The text above the table, applied to the script in the test: event before 15, changes
    before 1, 15 and 25."""
    sent: dict[int, str] = {}
    waiting_event = changed = False
    last = -1000
    for cycle in range(1, 85):
        changed |= cycle in {1, 15, 25}
        waiting_event |= cycle == 15 and given["event"]
        if given["frame divider"] and cycle % 3:
            continue
        clock = ""
        if given["cycle_us"]:
            clock = "" if cycle % 6 else "cycle"
        elif given["divider"]:
            clock = "divider" if cycle % 6 == 3 else ""
        elif not given["on_change"] and not given["event"]:
            clock = "divider" if given["frame divider"] else "cycle"
        if waiting_event:
            why = "event"
        elif clock:
            why = clock
        elif given["on_change"] and changed:
            why = "change"
        elif given["on_change"] and cycle - last >= 40:
            why = "change_timeout"
        else:
            continue
        sent[cycle] = why
        waiting_event = changed = False
        last = cycle
    return sent


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cycle_us": "cycle_us: 4000"}, "due every 4 cycles"),
        (
            {"cycle_us": "cycle_us: 6000", "frame divider": "divider: 3\n        modulo: 1"},
            "leaves",
        ),
        ({"cycle_us": "cycle_us: 1500"}, "no multiple of the device cycle"),
        ({"divider": "divider: 4"}, "due every 4 cycles"),
        ({"divider": "divider: 6\n        modulo: 1"}, "due at 1 of 6"),
        ({"divider": "divider: 6\n        modulo: 6"}, "never comes up"),
        ({"divider": "modulo: 1"}, "no divider"),
        ({"on_change": "on_change: {timeout_ms: 1, inhibit_us: 2000}"}, "before changes may be"),
    ],
)
def test_trigger_combinations_that_never_send_are_rejected(changes, message, tmp_path):
    given = dict.fromkeys(KEYS, False) | dict.fromkeys(changes, True) | {"frame divider": True}
    spec, findings = read(tmp_path, plant(given, VALUES | changes))
    assert spec is None
    assert any(message in finding for finding in findings), findings


def sending(**trigger: object) -> Line:
    """A line whose PD has these triggers."""
    gate = trigger.pop("gate", (0, 0))
    pd = TxPdSpec("p", 1, ("x",), trigger=TriggerSpec(**trigger))
    frame = TxFrameSpec("f", "eap0", "10.0.0.1", (pd,), *gate)
    return Line(station(variables=written("x:UINT"), frames=(frame,)))


def test_an_event_waits_while_the_gate_is_closed():
    line = sending(event=True, gate=(4, 0))
    line.put(p_VarCtrl=EVENT_BIT)
    line.run()
    line.put(p_VarCtrl=0)
    assert line.run(12) == {4: "event"}
    assert line.tx["skipped"] == 0


def test_several_events_between_two_frames_are_one():
    line = sending(event=True, gate=(4, 0))
    for value in (EVENT_BIT, 0, EVENT_BIT):
        line.put(p_VarCtrl=value)
        assert line.run() == {}
    assert line.run(9) == {4: "event"}


def test_an_event_bit_that_was_set_before_the_start_is_no_event():
    line = sending(event=True)
    line.put(p_VarCtrl=EVENT_BIT)
    again = Station(line.station.spec, line.image, lambda: None)
    again.connect("eap0", line.wire)
    line.station, line.due = again, again.start(line.due)
    line.put(x=1)
    assert line.run(5) == {}


def test_event_bit_without_event_trigger_is_ignored():
    line = sending(on_change=OnChangeSpec())
    line.run()
    line.put(p_VarCtrl=EVENT_BIT)
    assert line.run(5) == {}


def test_the_inhibit_time_holds_back_changes_only():
    line = sending(on_change=OnChangeSpec(inhibit_us=5000), event=True)
    sent = {}
    for value in range(1, 9):
        line.put(x=value)
        sent |= line.run()
    assert sent == {1: "change", 6: "change"}
    line.put(x=9, p_VarCtrl=EVENT_BIT)
    assert line.run(6) == {9: "event"}  # it carried the change
    line.put(x=10)
    assert line.run() == {15: "change"}


def test_change_reverted_while_held_is_not_sent():
    line = sending(on_change=OnChangeSpec(inhibit_us=5000))
    assert line.run() == {1: "change"}
    line.put(x=1)
    line.run(2)
    line.put(x=0)
    assert line.run(10) == {}


def test_the_change_time_out_counts_from_the_last_frame_of_any_reason():
    line = sending(on_change=OnChangeSpec(timeout_ms=10), event=True)
    assert line.run(8) == {1: "change"}
    line.put(p_VarCtrl=EVENT_BIT)
    assert line.run(20) == {9: "event", 19: "change_timeout"}


def test_without_a_time_out_the_unchanged_is_never_sent_again():
    line = sending(on_change=OnChangeSpec())
    assert line.run(100) == {1: "change"}


@pytest.mark.parametrize("control", ["p" + VAR_CTRL, "f.FrameCtrl"])
def test_suppression_beats_every_reason_uses_up_events_and_keeps_changes(control):
    line = sending(on_change=OnChangeSpec(), event=True)
    line.run()
    line.put(**{control.replace(".", "_"): 1})
    line.run()
    line.put(p_VarCtrl=EVENT_BIT | (control[0] == "p"))
    assert line.run(3) == {}
    assert line.tx["skipped"] == 1
    line.put(x=5, p_VarCtrl=int(control[0] == "p"))
    assert line.run(3) == {}
    assert line.tx["skipped"] == 4
    line.put(**{control.replace(".", "_"): 0})
    assert line.run(5) == {9: "change"}


@pytest.mark.parametrize("why", ["event", "change"])
def test_a_refused_frame_loses_neither_event_nor_change(why):
    line = sending(on_change=OnChangeSpec(), event=True)
    line.run()
    line.wire.refuse = True
    line.put(**({"p_VarCtrl": EVENT_BIT} if why == "event" else {"x": 7}))
    assert line.run(3) == {}
    assert (line.tx["skipped"], line.tx["frame_state"]) == (3, 1)
    line.wire.refuse = False
    assert line.run(5) == {5: why}
    assert line.tx["frame_state"] == 0


def test_a_refused_cycle_is_skipped_and_not_made_up_for():
    line = sending(cycle_us=4000)
    line.wire.refuse = True
    assert line.run(5) == {}
    line.wire.refuse = False
    assert line.run(7) == {8: "cycle", 12: "cycle"}
    assert line.tx["skipped"] == 1


def test_schedules_come_from_the_pd_before_its_frame():
    gate = (5, 2)
    cycle, divider = REASON_INDEX[Reason.CYCLE], REASON_INDEX[Reason.DIVIDER]
    assert plan_schedule(TriggerSpec(), 1000, (0, 0)) == Schedule(1, 0, cycle)
    assert plan_schedule(TriggerSpec(), 1000, gate) == Schedule(5, 2, divider)
    assert plan_schedule(TriggerSpec(cycle_us=10_000), 1000, gate) == Schedule(10, 0, cycle)
    assert plan_schedule(TriggerSpec(divider=10, modulo=7), 1000, gate) == Schedule(10, 7, divider)
    for spec in (TriggerSpec(event=True), TriggerSpec(on_change=OnChangeSpec())):
        assert plan_schedule(spec, 1000, gate) is None


def test_a_trigger_without_reasons_has_none():
    trigger = Trigger(TriggerSpec(event=True), None)
    assert trigger.reason(0, 0, None) is None
    trigger.raise_event()
    assert trigger.reason(0, 0, None) == REASON_INDEX[Reason.EVENT]
    trigger.clear_event()
    assert trigger.reason(0, 0, None) is None
