"""Appliances to talk to, without their processes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.support.fakeappliance import Appliance


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty runtime directory."""
    root = tmp_path / "run"
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(root))
    return root


@pytest.fixture
def appliance(runtime: Path) -> Iterator[Appliance]:
    """Plant ``line`` with the stations mixer and filler."""
    with ExitStack() as stack:
        yield Appliance("line", ["mixer", "filler"], stack)


@pytest.fixture
def bus_appliance(runtime: Path) -> Iterator[Appliance]:
    """Plant ``works``: station press has bus0 (coe) and bus1 (drive), station saw has none."""
    with ExitStack() as stack:
        running = Appliance("works", ["press", "saw"], stack, ["coe", "drive"])
        running.wait_served()
        yield running


@pytest.fixture
def other_appliance(appliance: Appliance) -> Iterator[Appliance]:
    """Plant ``hall`` beside ``line``, with the stations oven and, once more, mixer."""
    with ExitStack() as stack:
        yield Appliance("hall", ["oven", "mixer"], stack)
