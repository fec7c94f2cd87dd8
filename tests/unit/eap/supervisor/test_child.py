"""One child process: start, readiness, output, end; and when it comes back."""

from __future__ import annotations

import errno
import os
import select
import signal
from pathlib import Path
from time import monotonic_ns

import pytest

from eap.runtime.handover import Handover
from eap.supervisor import child as module
from eap.supervisor.child import Child, RestartPolicy, describe_end

SECOND_NS = 1_000_000_000
HANDOVER = Handover(os.getpid(), "/nowhere", "demo", "demo.yaml", (), ())
READS_ITS_HANDOVER = """\
import sys
from eap.runtime.handover import Handover
def main(handover_fd, startup):
    handover = Handover.from_descriptor(handover_fd)
    startup.step("reading")
    startup.step("reading")
    startup.finish({"plant": handover.plant})
    print("first line")
    sys.stderr.write("no newline")
    return 3
"""


def test_a_long_life_is_followed_by_a_start_at_once():
    policy = RestartPolicy()
    assert [policy.delay_ns(2 * SECOND_NS) for _ in range(4)] == [0, 0, 0, 0]


def test_short_lives_wait_ever_longer_up_to_a_limit():
    policy = RestartPolicy()
    delays = [policy.delay_ns(1) for _ in range(10)]
    assert delays[0] == 0
    assert delays[1] == module.FIRST_BACKOFF_NS
    assert delays == sorted(delays)
    assert delays[-1] == module.LONGEST_BACKOFF_NS
    assert policy.delay_ns(module.HEALTHY_AFTER_NS) == 0


@pytest.mark.parametrize(
    ("code", "words"),
    [(0, "exit code 0"), (2, "exit code 2"), (-9, "killed by SIGKILL"), (-77, "by signal 77")],
)
def test_ends_have_words(code, words):
    assert words in describe_end(code)


def make(tmp_path: Path, monkeypatch, code: str, bytecode: str = "") -> Child:
    (tmp_path / "eap_child_for_test.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{Path.cwd()}")
    return Child("test", "eap_child_for_test", bytecode)


def wait(fd: int) -> None:
    assert select.select([fd], [], [], 10)[0] == [fd]


@pytest.mark.net
def test_from_start_to_end(tmp_path, monkeypatch, capfd):
    child = make(tmp_path, monkeypatch, READS_ITS_HANDOVER)
    assert child.pid == 0
    child.start(HANDOVER, [], monotonic_ns())
    assert child.pid
    steps = []
    while not child.is_ready:
        wait(child.report_fd)
        steps += [each.step for each in child.take_reports()]
    assert [steps[0], *steps[-2:]] == ["importing modules", "reading", ""]
    assert steps.count("reading") == 1
    assert child.report == {"plant": "demo"}
    assert child.report_fd == -1
    wait(child.pid_fd)
    assert child.reap() == (3, "no newline")
    assert (child.pid, child.pid_fd, child.error_fd) == (0, -1, -1)
    assert not child.is_ready
    assert capfd.readouterr().err == "first line\nno newline\n"


@pytest.mark.net
def test_one_that_dies_before_it_is_ready(tmp_path, monkeypatch):
    child = make(tmp_path, monkeypatch, "import signal; signal.pause()")
    child.start(HANDOVER, [], monotonic_ns())
    assert not child.forward_output()
    child.ask_to_end(signal.SIGKILL)
    wait(child.pid_fd)
    while child.report_fd >= 0:
        child.take_reports()
    assert not child.is_ready
    assert child.reap() == (-signal.SIGKILL, "it said nothing")
    child.ask_to_end(signal.SIGTERM)  # nobody is there: nothing happens


@pytest.mark.net
@pytest.mark.parametrize("call", ["memfd_create", "pidfd_open"])
def test_child_that_cannot_be_started_leaves_nothing_behind(tmp_path, monkeypatch, call):
    def refuse(*_):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    child = make(tmp_path, monkeypatch, "import signal; signal.pause()")
    monkeypatch.setattr(os, call, refuse)
    before = sorted(Path("/proc/self/fd").iterdir())
    with pytest.raises(OSError, match="Too many open files"):
        child.start(HANDOVER, [], monotonic_ns())
    child.close()
    assert child.pid == 0
    assert sorted(Path("/proc/self/fd").iterdir()) == before
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)


@pytest.mark.net
def test_child_that_is_interrupted_while_it_starts_ends_without_a_traceback(tmp_path, monkeypatch):
    child = make(tmp_path, monkeypatch, READS_ITS_HANDOVER)
    child.start(HANDOVER, [], monotonic_ns())
    child.ask_to_end(signal.SIGINT)
    wait(child.pid_fd)
    assert child.reap() == (-signal.SIGTERM, "it said nothing")


@pytest.mark.net
def test_bytecode_that_python_may_not_write_is_kept_for_the_next_start(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    child = make(tmp_path, monkeypatch, READS_ITS_HANDOVER, bytecode=str(tmp_path / "bytecode"))
    for _ in range(2):
        child.start(HANDOVER, [], monotonic_ns())
        wait(child.pid_fd)
        assert child.reap()[0] == 3
    (kept,) = (tmp_path / "bytecode").rglob("eap_child_for_test.*.pyc")
    assert kept.read_bytes()
    assert not (tmp_path / "__pycache__").exists()
