from __future__ import annotations

import re
import textwrap
from pathlib import Path

import pytest

from eap.config.index import ExpectedBus
from eap.config.load import PlantResult, load
from eap.config.record import records_of
from eap.config.record_texts import (
    AFTER_NS,
    BEFORE_NS,
    SPLIT_NS,
    FileSplit,
    RecordTimes,
    split_of,
    times_of,
)
from tests.unit.eap.config.test_web import PLANT

SECOND = 10**9


def result(tmp_path, record: str) -> PlantResult:
    file = tmp_path / "plant.yaml"
    file.write_text(PLANT + "record:\n" + textwrap.indent(record, "  "))
    return load(file, lambda path: ExpectedBus())


def findings(tmp_path, record: str) -> list[str]:
    found = result(tmp_path, f"- {{name: day, {record}}}\n").findings
    return [re.sub(r"^.*?plant.yaml:\d+: ", "", str(each)) for each in found]


@pytest.mark.parametrize(
    "keys",
    [
        "folder: rec",
        "folder: rec, of: mixer, every: 10, split: 200MB, keep: 3",
        "folder: rec, of: [mixer/sp*, mixer/state, 'mi*'], every: 100ms",
        "folder: rec, of: mixer/eap0, kind: frames, ring: 60",
        "folder: rec, when: mixer/speed>3 or lost or mixer/late, before: 3s",
        "folder: rec, when: 'mixer/path[2]==1'",
        "folder: rec, when: mixer/state.VarCtrl==0",
        "to: 'postgresql://logger@db/plant', every: 1000ms",
    ],
)
def test_record_takes_the_options_of_the_command(tmp_path, keys):
    assert findings(tmp_path, keys) == []


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("keep: 3", "recording day: it has no folder for its files; expected a folder"),
        ("folder: r, of: mixer/sped", "mixer/sped: it selects no variable, did you mean mixer/spe"),
        ("folder: r, of: mixer/speed, kind: frames", "it selects no port"),
        ("folder: r, kind: frames, every: 2", "every: it is for values: frames are recorded as"),
        ("folder: r, every: two", "every: 'two'; expected cycles, such as 10, or a time such as"),
        ("folder: r, split: 3 miles", "'3 miles'; expected a time such as 1h, or a size such as"),
        ("folder: r, ring: soon", "ring: 'soon' is not a time; expected for example 20s"),
        ("folder: r, after: 3s", "after: it needs a condition"),
        ("folder: r, ring: 3s, when: lost, before: 4s", "before: it is longer than the ring"),
        ("folder: r, when: lost>", "a name or a value is expected"),
        ("folder: r, when: losst", "'losst' is no counter, did you mean lost?"),
        ("folder: r, when: mixer/sped>3", "station mixer has no variable 'sped', did you mean"),
        ("folder: r, to: 'influx+udp://h'", "to: a store takes values as they come"),
        ("to: 'mysql://h/d'", "to: 'mysql://h/d' is no store; expected postgresql://"),
        ("folder: r, keep: 0", "keep is 0; expected a whole number"),
    ],
)
def test_record_key_that_is_wrong_is_one_finding(tmp_path, keys, message):
    found = findings(tmp_path, keys)
    assert len(found) == 1
    assert message in found[0]


def test_record_with_names_that_are_wrong_is_one_finding_each(tmp_path):
    text = "- {name: a b, folder: r}\n- {name: day, folder: r}\n- {name: day, folder: s}\n"
    assert [each.message for each in result(tmp_path, text).findings] == [
        "recording 'a b'",
        "recording day is there twice",
    ]


def test_record_has_its_folder_beside_the_plant_file_and_ends_before_the_disk(tmp_path):
    text = (
        "- {name: day, folder: rec}\n"
        "- {name: fault, folder: /data, when: lost}\n"
        "- {name: db, to: 'influx+udp://h'}\n"
    )
    day, fault, store = result(tmp_path, text).plant.record
    assert (day.folder, fault.folder) == (str(tmp_path / "rec"), "/data")
    assert (split_of(day), times_of(day)) == (FileSplit(SPLIT_NS), RecordTimes())
    assert split_of(fault) == split_of(store) == FileSplit()
    assert times_of(fault) == RecordTimes(BEFORE_NS, BEFORE_NS, AFTER_NS)


@pytest.mark.parametrize("page", ["plant-file.md", "recordings.md"])
def test_examples_of_the_pages_are_right(tmp_path, page):
    text = (Path(__file__).parents[4] / "docs" / page).read_text()
    (example,) = re.findall(r"```yaml\nrecord:\n(.*?)```", text, re.DOTALL)
    example = example.replace("island-02/temperature", "mixer/speed")
    found = result(tmp_path, textwrap.dedent(example))
    assert [str(each) for each in found.findings] == []
    assert len(found.plant.record) == 2


@pytest.mark.parametrize(
    ("of", "stations", "expected"),
    [
        ("", ["mixer"], True),
        (", of: mixer/speed", ["mixer", "other"], True),
        (", of: [mixer/eap0], kind: frames", ["other"], False),
        (", of: 'm*/speed'", ["mixer"], True),
    ],
)
def test_host_has_the_recordings_of_its_stations(tmp_path, of, stations, expected):
    (section,) = result(tmp_path, f"- {{name: day, folder: r{of}}}\n").plant.record
    assert records_of(section, stations) is expected
