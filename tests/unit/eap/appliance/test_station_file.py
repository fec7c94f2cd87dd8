from __future__ import annotations

import pytest

from eap.appliance.durable import seal
from eap.appliance.station_file import VERSION, StationFile
from eap.errors import EnvironmentalError


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path))
    return StationFile("a plant", "left", "notes", list[int], "notes")


def test_a_value_comes_back_after_a_new_start(file):
    assert file.read() is None
    file.save([1, 2])
    assert StationFile("a plant", "left", "notes", list[int], "notes").read() == [1, 2]


@pytest.mark.parametrize(
    ("data", "reason"),
    [(b"x", "it is not whole"), (seal(b'["a"]', VERSION), "it holds no notes: Expected `int`")],
)
def test_a_damaged_file_is_put_aside(file, caplog, data, reason):
    file.save([1])
    file.path.write_bytes(data)
    assert file.read() is None
    assert f"station left: notes in {file.path} cannot be used: {reason}" in caplog.text
    assert file.path.with_suffix(".damaged").read_bytes() == data
    assert file.read() is None


def test_what_cannot_be_read_or_kept_says_so(file, caplog):
    file.path.mkdir(parents=True)
    assert file.read() is None
    assert "cannot be read (Is a directory)" in caplog.text
    with pytest.raises(EnvironmentalError, match=r"notes cannot be kept in .*; set EAP_STATE_DIR"):
        file.save([1])


def test_a_file_is_set_aside_and_brought_back(file):
    file.set_aside()
    file.bring_back()
    assert file.read() is None
    file.save([1])
    file.set_aside()
    assert file.read() is None
    file.bring_back()
    assert file.read() == [1]
    file.set_aside()
    file.save([2])
    file.bring_back()
    assert file.read() == [2]
