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
from eap.supervisor.child import (
    FIRST_LIMIT_NS,
    LONGEST_LIMIT_NS,
    SILENT_CHECKS,
    Child,
    LifeWatch,
    RestartPolicy,
    StartEvent,
    StartWatch,
    describe_end,
)
from eap.supervisor.log_output import Output
from tests.support.limits import largest_file

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


def test_life_is_given_up_after_several_looks_without_a_sign_in_a_row():
    life = LifeWatch()
    looks = [False, False, False, True, *[False] * SILENT_CHECKS, False, True]
    assert [life.check(is_alive=each) for each in looks] == [
        *[False] * (3 + SILENT_CHECKS), True, False, False,
    ]  # fmt: skip
    assert life.has_hung


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
        steps += [each.step for each in child.read_reports()]
    assert [steps[0], *steps[-2:]] == ["importing modules", "reading", ""]
    assert steps.count("reading") == 1
    assert child.report == {"plant": "demo"}
    assert child.report_fd == -1
    wait(child.pid_fd)
    assert child.reap() == (3, "no newline")
    assert (child.pid, child.pid_fd, child.error_fd) == (0, -1, -1)
    assert not child.is_ready
    assert capfd.readouterr().err == "first line\nno newline\n"


BEATS = """\
import signal
def main(handover_fd, startup):
    signal.signal(signal.SIGUSR1, lambda *_: startup.beat())
    startup.finish({}, is_watched=True)
    while True:
        signal.pause()
"""


@pytest.mark.net
def test_signs_of_life_of_a_child_are_seen_once(tmp_path, monkeypatch):
    child = make(tmp_path, monkeypatch, BEATS)
    assert child.has_beaten(), "none is due"
    child.start(HANDOVER, [], monotonic_ns())
    while not child.is_ready:
        wait(child.report_fd)
        child.read_reports()
    assert not child.has_beaten()
    child.send_signal(signal.SIGUSR1)
    wait(child.report_fd)
    assert child.has_beaten()
    assert not child.has_beaten()
    child.send_signal(signal.SIGKILL)
    wait(child.pid_fd)
    assert child.reap()[0] == -signal.SIGKILL
    assert child.report_fd == -1


@pytest.mark.net
def test_child_that_dies_before_ready(tmp_path, monkeypatch):
    child = make(tmp_path, monkeypatch, "import signal; signal.pause()")
    child.start(HANDOVER, [], monotonic_ns())
    assert not child.forward_output()
    child.send_signal(signal.SIGKILL)
    wait(child.pid_fd)
    while child.report_fd >= 0:
        child.read_reports()
    assert not child.is_ready
    assert child.reap() == (-signal.SIGKILL, "no output")
    child.send_signal(signal.SIGTERM)  # nobody is there: nothing happens


def children() -> list[str]:
    """Return the processes that this one has started and not reaped."""
    return [
        each
        for file in Path("/proc/self/task").glob("*/children")
        for each in file.read_text().split()
    ]


@pytest.mark.net
@pytest.mark.parametrize("call", ["memfd_create", "pidfd_open"])
def test_child_that_cannot_be_started_leaves_nothing_behind(tmp_path, monkeypatch, call):
    def refuse(*_):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    child = make(tmp_path, monkeypatch, "import signal; signal.pause()")
    monkeypatch.setattr(os, call, refuse)
    before, others = sorted(Path("/proc/self/fd").iterdir()), children()
    with pytest.raises(OSError, match="Too many open files"):
        child.start(HANDOVER, [], monotonic_ns())
    child.close()
    assert child.pid == 0
    assert sorted(Path("/proc/self/fd").iterdir()) == before
    assert children() == others


@pytest.mark.net
def test_child_that_is_interrupted_while_it_starts_ends_without_a_traceback(tmp_path, monkeypatch):
    child = make(tmp_path, monkeypatch, READS_ITS_HANDOVER)
    child.start(HANDOVER, [], monotonic_ns())
    child.send_signal(signal.SIGINT)
    wait(child.pid_fd)
    assert child.reap() == (-signal.SIGTERM, "no output")


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


@pytest.fixture
def pipe():
    reading, writing = os.pipe()
    with os.fdopen(reading), os.fdopen(writing, "w"):
        yield reading, writing


def read(fd: int) -> str:
    found = b""
    while select.select([fd], [], [], 0)[0]:
        found += os.read(fd, 65536)
    return found.decode()


def test_output_writes_lines(pipe):
    output = Output(pipe[1])
    for line in ("first", "second ä", "x" * 10_000):
        output.write(line)
    assert read(pipe[0]) == f"first\nsecond ä\n{'x' * 10_000}\n"
    assert output.dropped == 0


def test_output_drops_and_counts_lines_of_slow_reader(pipe):
    output = Output(pipe[1])
    while not output.dropped:
        output.write("y" * 1000)
    output.write("nobody sees this")
    read(pipe[0])
    output.write("and this again")
    assert read(pipe[0]) == "(2 lines dropped here: the reader was too slow)\nand this again\n"


def test_output_ignores_closed_reader(pipe):
    output = Output(pipe[1])
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, pipe[0])  # closes the reading end, and leaves a descriptor to close
    os.close(null)
    output.write("nobody sees this")
    assert output.dropped == 1


def test_output_line_after_full_disk_starts_new_line(tmp_path):
    with (tmp_path / "log").open("wb") as file:
        output = Output(file.fileno())
        output.write("first")
        with largest_file(10):
            output.write("second is long")
            output.write("third")
        assert output.dropped == 2
        output.write("fourth")
        output.write("fifth")
    lines = (tmp_path / "log").read_text().splitlines()
    assert lines == [
        "first", "seco", "(2 lines dropped here: the reader was too slow)", "fourth", "fifth",
    ]  # fmt: skip


def test_output_line_after_full_pipe_starts_new_line(pipe):
    output = Output(pipe[1])
    output.write("y" * 100_000)
    found = read(pipe[0])
    assert set(found) == {"y"}
    output.write("next")
    assert read(pipe[0]) == "\n(1 lines dropped here: the reader was too slow)\nnext\n"


PROGRESS_SECOND_NS = 1_000_000_000


def events_until(watch: StartWatch, from_ns: int, until_ns: int) -> list[tuple[int, StartEvent]]:
    """Return what the passing of time brings, with the second at which it does."""
    found = []
    now_ns = from_ns
    while (due_ns := watch.next_timeout()) is not None and due_ns <= until_ns:
        now_ns = max(now_ns, due_ns)
        assert watch.handle_timeout(due_ns - 1) is None
        event = watch.handle_timeout(now_ns)
        assert event is not None
        found.append((now_ns // PROGRESS_SECOND_NS, event))
    return found


def begun() -> StartWatch:
    watch = StartWatch()
    watch.begin(0)
    return watch


def test_start_without_progress_is_stuck_after_the_first_limit():
    watch = begun()
    assert events_until(watch, 0, 10**12) == [(10, StartEvent.SLOW), (20, StartEvent.STUCK)]
    assert watch.is_stuck
    assert watch.step == "starting Python"


def test_start_that_goes_on_is_never_stuck():
    watch, now_ns = begun(), 0
    events = []
    for number in range(100):
        now_ns += FIRST_LIMIT_NS - PROGRESS_SECOND_NS
        events += events_until(watch, now_ns, now_ns)
        watch.advance(f"building station {number}", now_ns)
    assert {event for _, event in events} == {StartEvent.SLOW}
    assert len(events) < 10  # notes come ever later
    watch.succeed()
    assert watch.next_timeout() is None


def test_start_that_repeats_a_step_makes_no_progress():
    watch = begun()
    watch.advance("waiting", 15 * PROGRESS_SECOND_NS)
    watch.advance("waiting", 30 * PROGRESS_SECOND_NS)
    assert (35, StartEvent.STUCK) in events_until(watch, 30 * PROGRESS_SECOND_NS, 10**12)


def test_limit_doubles_with_each_start_that_is_stuck_until_one_succeeds():
    watch, limits = begun(), []
    for _ in range(8):
        watch.begin(0)
        limits.append(watch.limit_ns)
        assert events_until(watch, 0, 10**13)[-1] == (
            limits[-1] // PROGRESS_SECOND_NS,
            StartEvent.STUCK,
        )
        watch.end()
    assert limits[:3] == [FIRST_LIMIT_NS, 2 * FIRST_LIMIT_NS, 4 * FIRST_LIMIT_NS]
    assert limits[-1] == LONGEST_LIMIT_NS
    watch.begin(0)
    watch.succeed()
    assert watch.has_run
    assert watch.limit_ns == FIRST_LIMIT_NS


def test_start_that_waits_for_another_process_has_no_limit_until_that_runs():
    watch = begun()
    watch.advance("waiting for the engine", 0, waits_for="engine")
    assert {event for _, event in events_until(watch, 0, 10**13)} == {StartEvent.SLOW}
    watch.release("services", 10**13)
    watch.release("engine", 10**13)
    assert events_until(watch, 10**13, 10**14)[-1] == (10_020, StartEvent.STUCK)


def test_process_that_ended_is_not_watched():
    watch = begun()
    watch.end()
    assert watch.next_timeout() is None
    assert watch.handle_timeout(10**15) is None
    assert (watch.step, watch.took_ns(5)) == ("", 0)
