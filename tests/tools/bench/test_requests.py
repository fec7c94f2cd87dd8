"""Plants and figures of requests by OPC UA and S7."""

from __future__ import annotations

from pathlib import Path

import pytest

from eap.runtime.plantfile import load_plant
from tools.bench.requests import PROTOCOLS, Protocol, figure_of, plant


@pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda each: each.bridge)
def test_plant_of_each_bridge_is_a_plant(tmp_path: Path, protocol: Protocol) -> None:
    path = tmp_path / "values.yaml"
    path.write_bytes(plant(protocol))
    assert not load_plant(path).findings


def test_reads_are_compared_by_round() -> None:
    figure = figure_of(PROTOCOLS[0], [(600.0, 300.0), (500.0, 500.0), (400.0, 400.0)])
    assert figure.name == "reads by OPC UA of a value: of the server of asyncua"
    assert (figure.value, figure.measured) == (1.0, "1.00 (0.50 to 0.40 thousand/s)")
