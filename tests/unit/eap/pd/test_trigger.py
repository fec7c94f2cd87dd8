"""The truth table of docs/triggers.md, walked row by row, and each rule below it."""

from __future__ import annotations

from pathlib import Path

import pytest

from eap.pd.layout import VAR_CTRL
from eap.pd.report import station_status
from eap.pd.spec import OnChangeSpec, StationSpec, TriggerSpec, TxFrameSpec, TxPdSpec
from eap.pd.station import Station
from eap.pd.trigger import EVENT_BIT, Schedule, Trigger, plan_schedule
from eap.pd.words import REASON_INDEX, Reason
from eap.runtime.plantfile import load_plant
from tests.support.cyclic import MS, Wire, image_of, station, written

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
    for given in combinations(row):
        spec, findings = read(tmp_path, plant(given))
        if row[6].startswith("*refused*"):
            assert spec is None
            assert findings
            continue
        assert spec is not None, findings
        line = Line(spec)
        expected = predicted(given)
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
    """What the text above the table says of the script in the test: event before 15, changes
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
def test_what_could_never_be_sent_as_written_is_refused(changes, message, tmp_path):
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


def test_an_event_bit_without_an_event_trigger_does_nothing():
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


def test_a_change_that_went_back_while_it_was_held_is_not_sent():
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
    trigger.use_up_event()
    assert trigger.reason(0, 0, None) is None
