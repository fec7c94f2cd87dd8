"""Lines of the audit are in its file as a whole, or not at all."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
from pathlib import Path

import pytest

from eap.services.control import audit as module
from eap.services.control.audit import AuditFile
from tests.support.limits import largest_file


@pytest.fixture
def file(tmp_path: Path) -> AuditFile:
    return AuditFile(tmp_path / "plant" / "audit.jsonl")


def hold_lock(file: AuditFile) -> int:
    """Return a descriptor that holds the lock of *file*, which has one line."""
    file.append(b"one\n")
    other = os.open(file.path, os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    return other


def test_append_makes_the_folder_for_its_owner_alone(file: AuditFile) -> None:
    file.append(b"one\n")
    assert stat.S_IMODE(file.path.parent.stat().st_mode) == 0o700
    assert file.path.read_bytes() == b"one\n"


def test_append_takes_a_short_write_back(file: AuditFile) -> None:
    file.append(b"one\n")
    with largest_file(8), pytest.raises(OSError, match="File too large"):
        file.append(b"two is longer\n")
    assert file.path.read_bytes() == b"one\n"
    file.append(b"three\n")
    assert file.path.read_bytes() == b"one\nthree\n"


def test_append_ends_a_line_that_was_broken_off(file: AuditFile) -> None:
    file.append(b"one\n")
    with file.path.open("ab") as other:
        other.write(b'{"half')
    file.append(b"two\n")
    assert file.path.read_bytes() == b'one\n{"half\ntwo\n'


def test_append_follows_a_file_that_was_moved_away(file: AuditFile) -> None:
    file.append(b"one\n")
    file.path.rename(file.path.with_suffix(".old"))
    file.append(b"two\n")
    assert file.path.read_bytes() == b"two\n"


def test_append_fails_while_another_process_holds_the_lock(
    file: AuditFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(file, "_wait_s", 0.0)
    other = hold_lock(file)
    with pytest.raises(OSError, match="another process holds its lock"):
        file.append(b"two\n")
    os.close(other)
    file.append(b"three\n")
    assert file.path.read_bytes() == b"one\nthree\n"


def test_append_waits_for_the_lock_of_another_process(
    file: AuditFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = hold_lock(file)
    pauses: list[float] = []

    def pause() -> None:
        pauses.append(0.01)
        if len(pauses) == 3:
            os.close(other)

    monkeypatch.setattr(os, "sched_yield", pause)
    monkeypatch.setattr(module, "monotonic", lambda: sum(pauses))
    file.append(b"two\n")
    assert file.path.read_bytes() == b"one\ntwo\n"


def test_append_waits_only_once_for_a_lock_that_is_not_given_back(
    file: AuditFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = hold_lock(file)
    pauses: list[float] = []
    monkeypatch.setattr(os, "sched_yield", lambda: pauses.append(0.01))
    monkeypatch.setattr(module, "monotonic", lambda: sum(pauses))
    for _ in range(3):
        with pytest.raises(OSError, match="another process holds its lock"):
            file.append(b"two\n")
    os.close(other)
    assert sum(pauses) == pytest.approx(module.LOCK_S, rel=0.1)


def test_append_that_cannot_lock_leaves_no_descriptor_open(
    file: AuditFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.append(b"one\n")

    def refuse(_fd: int, _operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    before = sorted(Path("/proc/self/fd").iterdir())
    with pytest.raises(OSError, match="No locks available"):
        file.append(b"two\n")
    assert sorted(Path("/proc/self/fd").iterdir()) == before


def test_append_succeeds_where_a_full_file_cannot_be_put_aside(
    file: AuditFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_BYTES", 4)
    monkeypatch.setattr(module, "KEPT", 1)
    file.path.with_name("audit.jsonl.1").joinpath("x").mkdir(parents=True)
    file.append(b"one\n")
    file.append(b"two\n")
    assert file.path.read_bytes() == b"one\ntwo\n"


def test_append_does_not_follow_a_link(file: AuditFile, tmp_path: Path) -> None:
    file.path.parent.mkdir()
    file.path.symlink_to(tmp_path / "target")
    with pytest.raises(OSError, match="symbolic links"):
        file.append(b"one\n")
    assert not (tmp_path / "target").exists()


def test_full_file_is_put_aside(file: AuditFile, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_BYTES", 8)
    for number in range(module.KEPT + 2):
        file.append(f"line {number}\nmore\n".encode())
    assert not file.path.exists()
    names = sorted(each.name for each in file.path.parent.iterdir())
    assert names == [f"audit.jsonl.{number}" for number in range(1, module.KEPT + 1)]
    newest = file.path.with_name("audit.jsonl.1").read_text()
    assert newest == f"line {module.KEPT + 1}\nmore\n"
