"""Start-up of a child process as it reports it."""

from __future__ import annotations

import importlib
import os
import select
import signal
import sys
from collections.abc import Iterator

import pytest

from eap.runtime import startup as module
from eap.runtime.startup import Report, Startup, catch_end_signals
from tests.support.startup import read_reports


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    reading, writing = os.pipe()
    yield reading, writing
    os.close(reading)


def test_startup_reports_each_step_once_and_then_that_it_runs(pipe: tuple[int, int]) -> None:
    startup = Startup(pipe[1])
    startup.step("one")
    startup.step("one")
    startup.step("two", waits_for="engine")
    startup.finish({"slaves": 2})
    assert read_reports(pipe[0]) == [
        Report("one"), Report("two", "engine"), Report(ready={"slaves": 2}),
    ]  # fmt: skip
    assert os.read(pipe[0], 1) == b""


def test_startup_continues_without_reader(pipe: tuple[int, int]) -> None:
    os.set_blocking(pipe[1], False)
    startup = Startup(pipe[1])
    for number in range(3000):
        startup.step(f"step {number} {'x' * 40}")
    assert len(read_reports_there(pipe[0])) < 3000
    os.close(pipe[1])


def read_reports_there(fd: int) -> list[bytes]:
    return os.read(fd, 1 << 20).splitlines()


def test_imports_that_take_long_are_reported_with_their_number(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch, tmp_path
) -> None:
    seconds = iter(range(100))
    monkeypatch.setattr(module, "monotonic", lambda: float(next(seconds)))
    startup = Startup(pipe[1])
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "meta_path", [module._Finder(startup, ""), *sys.meta_path])
    for number in range(2):
        (tmp_path / f"slow_module_{number}.py").write_text("")
        importlib.import_module(f"slow_module_{number}")
    startup.finish({})
    steps = [each.step for each in read_reports(pipe[0])][:-1]
    assert steps == ["importing modules, 1 so far", "importing modules, 2 so far"]


def test_no_step_reports_nothing() -> None:
    module.no_step("building station a")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_can_be_waited_for(number):
    before = signal.getsignal(number)
    with catch_end_signals() as fd:
        assert select.select([fd], [], [], 0)[0] == []
        os.kill(os.getpid(), number)
        assert select.select([fd], [], [], 5)[0] == [fd]
        assert os.read(fd, 8) == bytes([number])
    assert signal.getsignal(number) is before
    assert signal.set_wakeup_fd(-1) == -1
