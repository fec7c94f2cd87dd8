from __future__ import annotations

import pytest

from eap.config.imports.insertion import InsertionError, insert_stations

PLANT = """\
# A plant, with comments.
plant: hall  # its name
defaults: {cycle_us: 5000}

stations:
  # The first one.
  - name: one
    net_id: 1.1.1.1.1.1   # router
    variables:
      a: UINT

# Behind the stations.
access: {audit: required}
"""
STATION = ["  - name: two", "    net_id: 2.2.2.2.1.1", "    ports:", "      []"]
TYPES = ["types:", "  E_Mode: {base: INT, values: {Off: 0}}"]


def test_stations_are_added_and_every_line_stays() -> None:
    text = insert_stations(PLANT, STATION, TYPES)
    lines = text.split("\n")
    assert [each for each in PLANT.split("\n") if each not in lines] == []
    assert lines[lines.index("types:") + 3] == "stations:"
    start = lines.index("  - name: two")
    assert lines[start - 2 : start] == ["      a: UINT", ""]
    assert lines[start + 4 : start + 6] == ["", "# Behind the stations."]


def test_indentation_line_ends_and_byte_order_mark_stay() -> None:
    text = "\ufeffplant: a\r\nstations:\r\n- name: one\r\n  net_id: 1.1.1.1.1.1\r\n"
    added = insert_stations(text, STATION)
    assert added == text + "\r\n- name: two\r\n  net_id: 2.2.2.2.1.1\r\n  ports:\r\n    []\r\n"


def test_file_without_a_line_end_gets_one() -> None:
    text = "plant: a\nstations:\n  - name: one"
    assert insert_stations(text, STATION[:1]) == f"{text}\n\n  - name: two\n"


@pytest.mark.parametrize(
    ("text", "types", "reason"),
    [
        ("plant: a\nstations: [{name: one}]\n", [], "not written with a line for each station"),
        ("plant: a\n", [], "it has no list of stations"),
        ("plant: a\nstations: []\n", [], "it has no list of stations"),
        ("plant: [a\n", [], "not a plant file that can be read"),
        (f"types: {{}}\n{PLANT}", TYPES, "its types are not a mapping from names"),
        (f"types: [a.tmc]\n{PLANT}", TYPES, "its types are not a mapping from names"),
        (f"types: {{A: INT}}\n{PLANT}", TYPES, "not written with a line for each type"),
        (f"types:\n  E_Mode: INT\n{PLANT}", TYPES, "it has another type E_Mode"),
        (
            "plant: a\nstations:\n  - &one\n    name: one\n  - <<: *one\n    text: |\n      x\n",
            [],
            "",
        ),
        (
            "plant: a\nstations:\n  - name: one\n    comment: |+\n      kept line ends\n\n\n",
            [],
            "without changing something else",
        ),
    ],
)
def test_files_that_lines_cannot_be_added_to_are_refused(
    text: str, types: list[str], reason: str
) -> None:
    if not reason:
        assert insert_stations(text, STATION, types).startswith(text)
        return
    with pytest.raises(InsertionError, match=reason):
        insert_stations(text, STATION, types)


def test_types_are_added_to_those_that_are_there() -> None:
    types = [
        *TYPES,
        "  ST_A: {members: {",
        "    a: INT,",
        "    b: INT}}",
        "  ST_B: {alias: ST_A}",
    ]
    own = "types:\n    E_Mode: {base: INT, values: {Off: 0}}  # mine\n    ST_B: {alias: ST_A}\n"
    lines = insert_stations(own + PLANT, STATION, types).split("\n")
    assert lines[:7] == [
        "types:",
        "    E_Mode: {base: INT, values: {Off: 0}}  # mine",
        "    ST_B: {alias: ST_A}",
        "    ST_A: {members: {",
        "      a: INT,",
        "      b: INT}}",
        "# A plant, with comments.",
    ]
    assert "  - name: two" in lines


def test_types_that_are_there_already_are_not_added() -> None:
    text = f"{TYPES[0]}\n{TYPES[1]}\n{PLANT}"
    assert insert_stations(text, STATION, TYPES) == f"{TYPES[0]}\n{TYPES[1]}\n" + insert_stations(
        PLANT, STATION
    )
