from __future__ import annotations

import msgspec
import pytest

from eap.config.convert import convert_to
from eap.config.document import read
from eap.config.finding import FindingReport


@pytest.mark.parametrize(
    ("old", "new", "finding"),
    [
        (
            "plant: pair",
            "plnt: pair",
            "1: unknown key 'plnt', did you mean plant?; one of plant, stations, defaults",
        ),
        ("id: 1,", "id: 70000,", "15: id is 70000; a whole number from 0 to 65535"),
        ("id: 1,", "id: true,", "15: id is True; a whole number from 0 to 65535"),
        ("id: 1,", "id: 1.0,", "15: id is 1.0; a whole number from 0 to 65535"),
        ("id: 1,", "id: ,", "15: id has no value; a whole number from 0 to 65535"),
        ("id: 1, ", "", "15: 'state' has no id; the key id"),
        ("timeout_ms: 50", "timeout_ms: [50]", "21: timeout_ms is a list; a whole number of"),
        ("timeout_ms: 50", "substitute: old", "21: substitute is 'old'; one of hold, zero, defaul"),
        ("timeout_ms: 50", "foreign: yes", "21: foreign is 'yes'; true or false"),
        ("{kind: counter}", "{kind: count}", "11: unknown kind 'count', did you mean counter?"),
        ("{kind: counter}", "{step: 1}", "11: count is a mapping; a mapping with a kind (counter"),
        ("{kind: counter}", "counter", "11: count is 'counter'; a mapping with a kind (counter"),
        ("{kind: counter}", "{kind: counter, stp: 2}", "11: unknown key 'stp', did you mean step"),
        ("{kind: counter}", "{kind: counter, variable: x}", "11: unknown key 'variable'"),
        ("{kind: counter}", "{kind: ramp, low: 0, high: .inf, period_ms: 9}", "11: high is inf"),
        ("count: UDINT", "count: [UDINT]", "9: count is a list; a mapping with type"),
        ("default: 2.5", "default: {a: 1}", "8: default is a mapping; a value, or a list"),
        ("{kind: counter}", "{kind: counter, step: 1.5}", "11: step is 1.5; a whole number"),
        ("variables: {a: REAL, b: UDINT}", "variables: [a, b]", "21: variables is a list; a map"),
        ("variables: {a: REAL, b: UDINT}", "variables: {a: REAL, b: {}}", "21: b has no type; th"),
        ("variables: [speed, count]", "variables: speed", "15: variables is 'speed'; a list"),
        ("plant: pair", "plant: pair\ny-note: 1", "2: unknown key 'y-note'; one of plant,"),
    ],
)
def test_what_does_not_fit_is_named_with_its_line(findings, old, new, finding):
    found = findings((old, new))
    assert len(found) == 1
    assert found[0].startswith(finding)


def test_keys_of_anchors_are_free_at_the_top(load_plant):
    assert load_plant(("plant: pair", "plant: pair\nx-note: {any: thing}")).plant is not None


def test_empty_lists_and_mappings_may_be_left_blank(load_plant):
    edits = [
        ("    sources:\n      count: {kind: counter}\n", "    sources:\n    subscribe:\n"),
    ]
    assert load_plant(*edits).plant is not None


def test_numbers_are_texts_where_a_text_is_wanted(load_plant):
    plant = load_plant(("unit: 1/min", "unit: 1, comment: 2.50")).plant
    speed = plant.stations[0].variables[0]
    assert (speed.unit, speed.comment) == ("1", "2.50")


def test_what_depends_on_an_item_that_cannot_be_read_is_not_blamed(findings):
    assert findings(("id: 1,", "id: one,")) == ["15: id is 'one'; a whole number from 0 to 65535"]


def test_errors_of_shape_and_of_sense_are_found_together_and_without_echo(findings):
    found = findings(
        ("id: 1, version: 3,", "id: 70000, version: 3, cycle_us: 15000,"),
        ("frame: out", "frmae: uot"),
        ("count: UDINT", "count: UDIMT"),
        ("    sources:", "    sorces:"),
        ("net_id: 127.0.9.2.1.1", "net_id: 127.0.9.1.1.1"),
    )
    assert [line.split(";")[0] for line in found] == [
        "9: count: 'UDIMT' is not a data type, did you mean UDINT?",
        "10: unknown key 'sorces', did you mean sources?",
        "15: unknown key 'frmae', did you mean frame?",
        "15: id is 70000",
        "15: station left has no frame 'uot', did you mean out?",
        "15: cycle_us 15000 of PD 'state' is no multiple of the device cycle, 10000",
        "17: NetID 127.0.9.1.1.1 is used twice (first in line 4)",
    ]


def test_a_document_that_is_no_mapping_is_one_finding(tmp_path):
    from eap.runtime.plantfile import load_plant

    path = tmp_path / "list.yaml"
    path.write_text("- plant")
    [finding] = load_plant(path).findings
    assert finding.message == "plant is a list"
    assert finding.expected == "a mapping with plant, stations"


def test_arrays_and_blocks_have_defaults(load_plant):
    pair = "pair: {type: 'REAL[2]', default: [1, 2.5]}"
    new = f"count: UDINT\n      {pair}\n      raw: {{type: BLOCK(2), default: 'beef'}}"
    plant = load_plant(("count: UDINT", new)).plant
    assert [v.default for v in plant.stations[0].variables] == [2.5, None, [1, 2.5], "beef"]


class Lamp(msgspec.Struct):
    watts: int
    colour: str | None = "white"


@pytest.mark.parametrize(
    ("text", "lamp", "messages"),
    [
        ("watts: 5", Lamp(watts=5), []),
        ("watts: 5\ncolour: null", Lamp(watts=5, colour=None), []),
        ("watts: 5\ncolour: ~", Lamp(watts=5, colour=None), []),
        ("watts: 5\ncolour:", Lamp(watts=5), ["colour has no value"]),
        ("colour: red", None, ["lamp has no watts"]),
        ("[5]", None, ["lamp is a list"]),
    ],
)
def test_any_struct_can_be_read(tmp_path, text, lamp, messages):
    path = tmp_path / "lamp.yaml"
    path.write_text(text)
    report = FindingReport(str(path))
    assert convert_to(Lamp, read(path, report), report, "lamp") == lamp
    assert [finding.message for finding in report.findings()] == messages
