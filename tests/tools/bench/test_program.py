"""The program: benchmarks that cannot run, and those that fail."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import pytest

from tools.bench import __main__ as program
from tools.bench.figures import Decision, Figure, SkippedError
from tools.bench.settings import quick


def section(monkeypatch: pytest.MonkeyPatch, run: Any) -> program.Section:
    module = ModuleType("tools.bench.fake")
    module.TITLE, module.run = "Fake", run  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return program._run("fake", quick())


def test_failed_benchmark_runs_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = []

    def run(settings: Any) -> list[Figure]:
        runs.append(settings)
        if len(runs) == 1:
            raise RuntimeError("it stood still")
        return [Figure("a", "1")]

    assert section(monkeypatch, run).figures == [Figure("a", "1")]


@pytest.mark.parametrize(
    ("error", "decision", "shown"),
    [
        (SkippedError("needs root"), Decision.SKIPPED, "needs root"),
        (ModuleNotFoundError(name="peer"), Decision.SKIPPED, "needs peer"),
        (KeyError("pid"), Decision.MISSED, "failed: 'pid'"),
        (RuntimeError("lost"), Decision.MISSED, "failed: lost"),
    ],
)
def test_benchmark_without_figures_says_why(
    monkeypatch: pytest.MonkeyPatch, error: Exception, decision: Decision, shown: str
) -> None:
    def run(settings: Any) -> list[Figure]:
        raise error

    (figure,) = section(monkeypatch, run).figures
    assert (figure.decision, figure.measured) == (decision, shown)
