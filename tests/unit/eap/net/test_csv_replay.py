from __future__ import annotations

import pytest

from eap.errors import EnvironmentalError
from eap.net.csv_replay import open_replay

MS = 1_000_000


def test_rows_follow_each_other_and_begin_again(tmp_path):
    path = tmp_path / "oven.csv"
    path.write_text("time,temperature\n0,180.5\n1,181\n2,179.25\n")
    replay = open_replay(path, "temperature", period_ms=100)
    times = (0, 99, 100, 250, 300, 650)
    assert [replay.value(at * MS) for at in times] == [
        "180.5",
        "180.5",
        "181",
        "179.25",
        "180.5",
        "180.5",
    ]


def test_a_short_row_has_an_empty_value(tmp_path):
    path = tmp_path / "short.csv"
    path.write_text("a,b\n1\n")
    assert open_replay(path, "b", period_ms=1).value(0) == ""


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "No such file"),
        (b"a,b\n1,2\n", "no column 'c'"),
        (b"", "no column 'c'"),
        (b"c\n", "no rows"),
        (b"c\n\xff\n", "UTF-8"),
        (b'c\n"1\n', "no CSV file"),
    ],
)
def test_a_file_that_cannot_be_replayed_is_named(tmp_path, content, words):
    path = tmp_path / "bad.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(EnvironmentalError, match=words) as caught:
        open_replay(path, "c", period_ms=1)
    assert str(path) in str(caught.value)
