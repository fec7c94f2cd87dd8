from __future__ import annotations

import os

from eap.config.hosts import why_unreadable


def test_a_file_is_readable_or_says_why_not(tmp_path):
    (tmp_path / "secret").touch()
    assert why_unreadable(tmp_path / "secret") == ""
    assert why_unreadable(tmp_path / "gone") == "No such file or directory"
    assert why_unreadable(tmp_path) == "Is a directory"
    os.mkfifo(tmp_path / "pipe")
    assert why_unreadable(tmp_path / "pipe") == "no regular file"
    assert "null" in why_unreadable(tmp_path / "a\0b")
