from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from tools.fuzz.__main__ import load_seeds
from tools.fuzz.sockets import FuzzedAppliance, fuzz_sockets


def test_appliance_survives_damaged_messages_at_all_its_sockets() -> None:
    count, find = fuzz_sockets(2.0, 3, load_seeds())
    assert find is None
    assert count > 0


def test_process_that_ended_is_a_find(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    send = FuzzedAppliance.send

    def send_and_kill(self: FuzzedAppliance, *arguments: object) -> None:
        send(self, *arguments)  # type: ignore[arg-type]
        engine = next(row["pid"] for name, row in self.processes.items() if "engine" in name)
        if engine not in killed:
            killed.append(engine)
            os.kill(engine, signal.SIGKILL)

    killed: list[int] = []
    monkeypatch.setattr(FuzzedAppliance, "send", send_and_kill)
    _, find = fuzz_sockets(30.0, 3, [b"a seed"])
    assert find is not None
    assert "was started again" in find.text or "no answer" in find.text
    assert find.sent


def test_plant_that_does_not_start_leaves_no_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tools.fuzz.sockets.PLANT", "plant: fuzzed\nstation: []\n")
    appliance = FuzzedAppliance(tmp_path)
    with pytest.raises(RuntimeError, match="the appliance did not start"):
        appliance.__enter__()
    assert appliance.fault().startswith("the appliance ended")
