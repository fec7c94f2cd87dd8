from __future__ import annotations

import math
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.config.document import MAX_FILE, read
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
        (b"a: 1\nb: \xff", "p.yaml:2: octet 0xff is no UTF-8"),
        ("a: *x", "p.yaml:1: no anchor &x ends before this"),
        ("a: &a [*a]", "p.yaml:1: no anchor &a ends before this"),
        ("a: 1\n---\nb: 2", "p.yaml:2: a second YAML document begins"),
        ("? [1]\n: 2", "p.yaml:1: a key is a list or mapping"),
        ("a: !thing 3", "p.yaml:1: tag '!thing' is not supported"),
        ("a: {<<: 3}", "p.yaml:1: << merges something else"),
        ("[" * 200_000, "p.yaml:1: nested too deeply"),
    ],
)
def test_what_is_no_document_is_one_finding_with_its_line(tree, content, finding):
    _, findings = tree(content)
    assert len(findings) == 1
    assert findings[0].startswith(finding)


def test_a_bomb_of_aliases_is_defused(tree):
    lines = ["a0: &a0 [x]", *(f"a{n}: &a{n} [{f'*a{n - 1}, ' * 10}]" for n in range(1, 12))]
    node, findings = tree("\n".join(lines))
    assert node is None
    assert findings == [
        "p.yaml:6: aliases make the plant too large; expected at most 200000 values"
    ]


def test_a_byte_order_mark_is_no_part_of_the_first_key(tree):
    assert plain(tree(b"\xef\xbb\xbfa: 1")[0]) == {"a": 1}


def test_a_file_that_is_none_is_a_finding(tmp_path):
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
