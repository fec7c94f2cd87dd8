from __future__ import annotations

import os

import pytest

from eap.errors import EnvironmentalError
from eap.net.password import read_password, read_password_text


@pytest.mark.parametrize("content", ["secret", "secret\n", "secret\r\nmore\n"])
def test_the_first_line_is_the_password(tmp_path, content):
    file = tmp_path / "pw"
    file.write_bytes(content.encode())
    assert read_password(file) == b"secret"
    assert read_password_text(file) == "secret"


def test_octets_that_are_no_text(tmp_path):
    file = tmp_path / "pw"
    file.write_bytes(b"\xff\n")
    assert read_password(file) == b"\xff"
    with pytest.raises(EnvironmentalError, match="pw: its first line is not UTF-8"):
        read_password_text(file)


def test_what_is_no_regular_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for name in ("pipe", "."):
        with pytest.raises(EnvironmentalError, match=r"kept in a regular file|Is a directory"):
            read_password(tmp_path / name)
    with pytest.raises(EnvironmentalError, match="gone: No such file"):
        read_password(tmp_path / "gone")
