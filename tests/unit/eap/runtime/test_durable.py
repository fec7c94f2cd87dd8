from __future__ import annotations

import os
import re
import stat

import pytest

from eap.errors import ConfigError, EnvironmentalError
from eap.runtime import durable
from eap.runtime.durable import digest, put_aside, replace_file, seal, unseal, whole_file
from tests.support.limits import largest_file


def test_unseal_returns_sealed_content():
    assert unseal(seal(b'{"a":[1]}', 3), 3) == b'{"a":[1]}'
    assert digest(b"a") != digest(b"b")


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (seal(b'{"a":1}', 3)[:-1], "it is not whole"),
        (seal(b'{"a":1}', 3).replace(b'"a"', b'"b"'), "its content is not what was written"),
        (seal(b'{"a":1}', 4), "its version is 4, this release knows 3"),
        (b"\xff", "it is not whole"),
    ],
)
def test_anything_else_is_refused(data, reason):
    with pytest.raises(ConfigError, match=re.escape(reason)):
        unseal(data, 3)


def test_a_file_is_replaced_and_nothing_is_left_beside_it(tmp_path):
    path = tmp_path / "x.json"
    replace_file(path, b"one")
    replace_file(path, b"two")
    assert path.read_bytes() == b"two"
    assert [each.name for each in tmp_path.iterdir()] == ["x.json"]


def test_replace_file_failure_keeps_old_content(tmp_path, monkeypatch):
    path = tmp_path / "x.json"
    replace_file(path, b"one")

    def full(_fd):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(durable.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        replace_file(path, b"two")
    assert path.read_bytes() == b"one"
    assert len(os.listdir(tmp_path)) == 1  # noqa: PTH208  names only


def test_damaged_file_is_put_aside_or_reported(tmp_path, caplog):
    path = tmp_path / "x.json"
    path.touch()
    put_aside(path, tmp_path / "x.damaged")
    assert (tmp_path / "x.damaged").exists()
    put_aside(path, tmp_path / "x.damaged")
    assert "x.json cannot be renamed: No such file" in caplog.text


def test_whole_file_appears_once_it_is_complete(tmp_path):
    target = tmp_path / "a.bin"
    with whole_file(target) as file:
        file.write(b"one")
        assert not target.exists()
    assert target.read_bytes() == b"one"


@pytest.mark.parametrize("before", [None, b"before"])
def test_whole_file_on_full_disk_keeps_old_content(tmp_path, before):
    target = tmp_path / "a.bin"
    if before:
        target.write_bytes(before)
    with (
        largest_file(100),
        pytest.raises(EnvironmentalError, match=r"a\.bin cannot be written: File too large"),
        whole_file(target) as file,
    ):
        file.write(bytes(200))
    assert [each.read_bytes() for each in tmp_path.iterdir()] == ([before] if before else [])


def test_whole_file_keeps_the_rights_of_the_one_before(tmp_path):
    target = tmp_path / "secret"
    target.touch(mode=0o600)
    with whole_file(target) as file:
        file.write(b"new")
    assert target.read_bytes() == b"new"
    assert stat.S_IMODE(target.stat().st_mode) == 0o600
