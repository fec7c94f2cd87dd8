from __future__ import annotations

import math
import os

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.config.document import MAX_FILE, convert_to, read
from eap.config.finding import FindingReport


def plain(node):
    match node.value:
        case dict():
            return {key: plain(item) for key, (_, item) in node.value.items()}
        case list():
            return [plain(item) for item in node.value]
    return node.value


@pytest.fixture
def tree(tmp_path):
    def of(content):
        path = tmp_path / "plant.yaml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        report = FindingReport("p.yaml")
        return read(path, report), [str(finding) for finding in report.findings()]

    return of


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("5", 5),
        ("-5", -5),
        ("007", 7),
        ("0x1F", 31),
        ("0o17", 15),
        ("1.5", 1.5),
        ("1e3", 1000.0),
        (".inf", math.inf),
        ("-.inf", -math.inf),
        ("true", True),
        ("FALSE", False),
        ("on", "on"),
        ("10:20:30:40:50:60", "10:20:30:40:50:60"),
        ("2026-11-21", "2026-11-21"),
        ("'5'", "5"),
        ("!!str 5", "5"),
        ("~", None),
        ("", None),
    ],
)
def test_scalars_follow_yaml_1_2(tree, text, value):
    node, findings = tree(f"key: {text}")
    assert (plain(node), findings) == ({"key": value}, [])


def test_not_a_number_is_a_float(tree):
    assert math.isnan(plain(tree("[.nan]")[0])[0])


def test_nodes_know_their_lines(tree):
    node, _ = tree("a: 1\nb:\n  - x\n  - c: 2\n")
    line, items = node.value["b"]
    assert line == 2
    assert [item.line for item in items.value] == [3, 4]


def test_merge_keys_give_way_to_own_keys_and_to_earlier_ones(tree):
    node, findings = tree("a: &a {x: 1, y: 2}\nb: &b {y: 3, z: 4}\nc: {<<: [*a, *b], x: 0}")
    assert plain(node)["c"] == {"x": 0, "y": 2, "z": 4}
    assert not findings


@pytest.mark.parametrize(
    ("content", "finding"),
    [
        ("", "p.yaml:1: the file is empty; expected a plant file (docs/plant-file.md)"),
        ("a: 1\nb: 2\na: 3", "p.yaml:3: key 'a' is given twice (first in line 1)"),
        ("a: [1, 2\nb: 3", "p.yaml:2: not YAML: "),
        ("a: 1\nb: c: d", "p.yaml:2: not YAML: mapping values are not allowed"),
        ("a: \x07", "p.yaml: not YAML: unacceptable character"),
        (b"a: 1\nb: \xff", "p.yaml:2: byte 0xff is not UTF-8"),
        ("a: *x", "p.yaml:1: no anchor &x ends before this"),
        ("a: &a [*a]", "p.yaml:1: no anchor &a ends before this"),
        ("a: 1\n---\nb: 2", "p.yaml:2: a second YAML document begins"),
        ("? [1]\n: 2", "p.yaml:1: a key is a list or mapping"),
        ("a: !thing 3", "p.yaml:1: tag '!thing' is not supported"),
        ("a: {<<: 3}", "p.yaml:1: << merges something else"),
        ("[" * 200_000, "p.yaml:1: nested too deeply"),
    ],
)
def test_invalid_document_is_one_finding_with_its_line(tree, content, finding):
    _, findings = tree(content)
    assert len(findings) == 1
    assert findings[0].startswith(finding)


def test_document_with_too_many_aliases_is_refused(tree):
    lines = ["a0: &a0 [x]", *(f"a{n}: &a{n} [{f'*a{n - 1}, ' * 10}]" for n in range(1, 12))]
    node, findings = tree("\n".join(lines))
    assert node is None
    assert findings == [
        "p.yaml:6: aliases make the plant too large; expected at most 200000 values"
    ]


def test_a_byte_order_mark_is_no_part_of_the_first_key(tree):
    assert plain(tree(b"\xef\xbb\xbfa: 1")[0]) == {"a": 1}


def test_document_of_invalid_file_is_a_finding(tmp_path):
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    (tmp_path / "huge").write_bytes(b"#" * (MAX_FILE + 1))
    (tmp_path / "loop").symlink_to("loop")
    for name, words in {
        "": "is a directory",
        "missing": "does not exist",
        "fifo": "is not a regular file",
        "huge": "is too large",
        "a\0b": "does not exist",
        "x" * 300: "cannot be read: File name too long",
        "loop": "",
    }.items():
        report = FindingReport(name)
        assert read(tmp_path / name, report) is None
        [finding] = report.findings()
        assert words in finding.message


@given(st.binary(max_size=200) | st.text(alphabet="ab:-[]{}&*#'\"!<|>\n ?%@,\t", max_size=80))
def test_no_content_is_a_traceback(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    report = FindingReport("p.yaml")
    assert read(path, report) is not None or report.findings()


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("plant: x\nvariables:\n    a: REAL\n\t  b: REAL\n", 4, "line 4 begins with a tab"),
        ("plant: x\nstations:\n\t- name: a\n", 3, "line 3 begins with a tab"),
        ("\tplant: x\n", 1, "line 1 begins with a tab"),
        ("a:\n  -\t{b: c}\n", 2, "line 2 has a tab behind '-', '?' or ':'"),
    ],
)
def test_document_with_a_tab_as_indentation_is_refused_in_words(
    tree, text: str, line: int, what: str
) -> None:
    expected = "spaces: YAML takes no tabs there"
    assert tree(text) == (None, [f"p.yaml:{line}: {what}; expected {expected}"])


def test_document_with_tabs_that_yaml_takes_is_read(tree) -> None:
    node, findings = tree("a:\tb\nc: [1,\n\t2]\n")
    assert (plain(node), findings) == ({"a": "b", "c": [1, 2]}, [])


@pytest.mark.parametrize(
    ("old", "new", "finding"),
    [
        (
            "plant: pair",
            "plnt: pair",
            "1: unknown key 'plnt', did you mean plant?; one of plant, stations, defaults",
        ),
        ("id: 1,", "id: 70000,", "15: id is 70000; a whole number from 0 to 65535"),
        ("id: 1,", "id: true,", "15: id is true; a whole number from 0 to 65535"),
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
        ("default: 2.5", "default: {a: }", "8: a has no value; a value, or a list"),
        ("{kind: counter}", "{kind: counter, step: 1.5}", "11: step is 1.5; a whole number"),
        ("variables: {a: REAL, b: UDINT}", "variables: [a, b]", "21: variables is a list; a map"),
        ("variables: {a: REAL, b: UDINT}", "variables: {a: REAL, b: {}}", "21: b has no type; th"),
        ("variables: [speed, count]", "variables: speed", "15: variables is 'speed'; a list"),
        ("plant: pair", "plant: pair\ny-note: 1", "2: unknown key 'y-note'; one of plant,"),
    ],
)
def test_document_type_error_has_its_line(findings, old, new, finding):
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


def test_reference_to_unreadable_item_is_no_finding(findings):
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
