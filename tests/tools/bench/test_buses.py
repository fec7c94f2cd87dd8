"""Bus files for measurements."""

from __future__ import annotations

import pytest

from eap.runtime.busfile import load_or_raise
from tools.bench.buses import bus, encode, plain_bus


@pytest.mark.parametrize("make", [bus, plain_bus])
@pytest.mark.parametrize("slaves", [1, 4, 16, 32, 64])
def test_bus_of_any_size_has_the_same_process_data(tmp_path, make, slaves: int) -> None:
    path = tmp_path / "bus.yaml"
    path.write_bytes(encode(make(slaves, 512)))
    segment = load_or_raise(path).build().segment
    assert len(segment.slaves) == slaves
    data = [each.device.process_data for each in segment.slaves]
    assert sum(each.outputs.size + each.inputs.size for each in data) == 512
