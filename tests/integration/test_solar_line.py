"""The line of solar cells (config/solar-line.yaml): 15 stations and 54 PDs every 10 ms."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Appliance, Plants, troubles
from tests.support.machine import slowness

pytestmark = pytest.mark.net
IS_ABOUT_PROCESSES = True

PLANT = Path(__file__).parents[2] / "config/solar-line.yaml"
STATIONS = [f"island-{number:02}" for number in range(1, 15)] + ["control"]
DURATION_S = 10 if os.environ.get("EAP_LONG") else 3


def keyed(document: dict[str, Any]) -> Iterator[tuple[tuple[str, str], dict[str, Any]]]:
    """Yield each subscription behind its station and name."""
    for station in document["stations"]:
        for rx in station["pd"]["rx"]:
            yield (station["name"], rx["name"]), rx


@pytest.fixture
def appliance(farm: Plants) -> Appliance:
    appliance = farm.start(PLANT)
    assert appliance.wait_ready() == STATIONS
    return appliance


@pytest.mark.quiet
def test_seconds_of_the_solar_line(appliance: Appliance) -> None:
    before = {key: rx["received"] for key, rx in keyed(appliance.status())}
    time.sleep(DURATION_S)
    document = json.loads(appliance.command("status", "--json"))

    assert [station["name"] for station in document["stations"]] == STATIONS
    assert {station["state"] for station in document["stations"]} == {"OP"}
    assert all(station["discarded"] == {} for station in document["stations"])
    rows = dict(keyed(document))
    assert len(rows) == 26 + 28
    for key, rx in rows.items():
        assert troubles(rx) == (0, 0, 0)
        assert rx["discarded"] == {}
        assert rx["state"] == "running"
        # An engine that the host stops for half a second leaves cycles out.
        assert rx["received"] - before[key] > DURATION_S * 100 * 0.8
    processes = document["processes"]
    assert processes["engine"]["restarts"] == processes["services"]["restarts"] == 0
    assert processes["engine"]["rss"] <= 60 << 20
    assert_shape(document)

    start = time.monotonic()
    assert appliance.stop() == (0, "", "")
    assert time.monotonic() - start < 2 * slowness()


def assert_shape(document: dict[str, Any]) -> None:
    """Scripts rely on these names."""
    assert document["version"] == 1
    processes = document["processes"]
    assert {"pid"} <= set(processes["supervisor"])
    assert {"pid", "cpu", "rss", "realtime", "restarts"} <= set(processes["engine"])
    station = document["stations"][0]
    assert {"name", "net_id", "state", "ports", "discarded", "pd"} <= set(station)
    assert {"name", "kind", "net_id", "interface", "link"} <= set(station["ports"][0])
    assert {"name", "port", "sent", "skipped", "reason"} <= set(station["pd"]["tx"][0])
    names = {"name", "port", "received", "lost", "duplicated", "reordered", "late", "discarded"}
    assert names | {"quality", "age_us", "jitter_us", "state"} <= set(station["pd"]["rx"][0])
    assert {"p50", "p99", "max"} == set(station["pd"]["rx"][0]["jitter_us"])
