"""Figures of files that pass stations."""

from __future__ import annotations

from pathlib import Path

from eap.runtime.plantfile import load_plant
from tools.bench.files import plant, rates


def test_rate_and_what_hops_cost() -> None:
    rounds = [({"stored": 2.0}, {"stored": 1.0})] * 3
    (figure,) = rates("stored", rounds)
    assert figure.value == 0.5
    assert figure.measured == "0.50 MB/s, 0.50 of the 1.00 MB/s at the slave's own station"


def test_plant_can_be_loaded(tmp_path: Path) -> None:
    path = tmp_path / "files.yaml"
    path.write_text(plant())
    result = load_plant(path)
    assert result.plant is not None, result.findings
    (route,) = [each for each in result.plant.routing["first"].routes if each.name == "last"]
    assert route.hop.address == "127.0.9.42:34980"
