"""Modules on a path, from calls that were counted."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from tools.structure import paths
from tools.structure.paths import Calls, PlantError, find_passed, read_calls, trace_paths

TRACER = Path(__file__).parents[3] / "tools" / "structure" / "tracer"


def calls(**functions: int) -> Calls:
    return Counter({(f"eap/{name}.py", "run"): number for name, number in functions.items()})


def test_module_is_passed_when_each_operation_calls_it() -> None:
    busy = [calls(codec=10, timer=300, first=1)]
    assert find_passed(busy, [calls(timer=290)], [], 10) == ["eap.codec"]


def test_module_called_as_often_without_is_not_passed() -> None:
    assert find_passed([calls(cycle=10)], [calls(cycle=9)], [], 10) == []


def test_processes_are_rated_apart_and_counted_together() -> None:
    busy = [calls(codec=10), calls(codec=10, cycle=10, master=10)]
    idle = [calls(), calls(cycle=10)]
    assert find_passed(busy, idle, [], 10) == ["eap.codec", "eap.master"]


def test_each_module_of_a_command_is_passed() -> None:
    other = Counter({("tools/demo.py", "run"): 1})
    assert find_passed([], [], [calls(cli=1), other], 10) == ["eap.cli"]


def test_tracer_counts_calls_but_none_of_imports(tmp_path: Path) -> None:
    (tmp_path / "eap.py").write_text("def run(): pass\ndef made(): pass\nmade()\n")
    environment = os.environ | {
        "PYTHONPATH": f"{TRACER}:{tmp_path}", "STRUCTURE_FROM_START": "1",
        "STRUCTURE_ROOT": str(tmp_path), "STRUCTURE_TRACE": str(tmp_path),
    }  # fmt: skip
    subprocess.run(
        [sys.executable, "-c", "import eap; eap.run(); eap.run()"],
        cwd=tmp_path,
        env=environment,
        check=True,
    )
    (trace,) = tmp_path.glob("*.json")
    assert read_calls(trace) == {("eap.py", "run"): 2}


@pytest.mark.net
def test_paths_beside_a_running_plant_ends_at_once_with_a_remedy(monkeypatch) -> None:
    monkeypatch.setattr(paths, "_ADDRESS", "127.0.77.1")
    with (
        socket.create_server(("127.0.77.1", 48898)),
        pytest.raises(PlantError, match="in use: stop the demo plant that runs already"),
    ):
        trace_paths(Path())


@pytest.mark.net
def test_paths_of_a_plant_that_does_not_start_shows_its_error(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(paths, "_ADDRESS", "127.0.77.1")
    with pytest.raises(PlantError, match=r"ended with \d+:\n.*demo\.yaml"):
        trace_paths(tmp_path)
