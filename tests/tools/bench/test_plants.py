"""Generated plants are plants."""

from __future__ import annotations

from pathlib import Path

import pytest

from eap.runtime.plantfile import load_plant
from tools.bench.plants import line


@pytest.mark.parametrize("islands", [1, 2, 251])
def test_a_line_of_any_length_is_a_plant(tmp_path: Path, islands: int) -> None:
    file = tmp_path / "line.yaml"
    file.write_bytes(line(islands, 500))
    result = load_plant(file)
    assert not result.findings
    assert result.plant is not None
    assert [s.cycle_us for s in result.plant.stations] == [500] * (islands + 1)
    received = sum(len(station.subscriptions) for station in result.plant.stations)
    assert received == 2 * (islands - 1) + 2 * islands
