"""The line of solar cells (config/solar-line.yaml): 15 stations and 54 PDs every 10 ms."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Plants, troubles

pytestmark = pytest.mark.net

PLANT = Path(__file__).parents[2] / "config/solar-line.yaml"
DURATION_S = 10


def subscriptions(document: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for station in document["stations"]:
        yield from station["pd"]["rx"]


@pytest.mark.quiet
def test_ten_seconds_of_the_solar_line(farm: Plants) -> None:
    appliance = farm.start(PLANT)
    stations = [f"island-{number:02}" for number in range(1, 15)] + ["control"]
    assert appliance.wait_ready() == stations
    time.sleep(DURATION_S)
    document = json.loads(appliance.command("status", "--json"))

    assert [station["name"] for station in document["stations"]] == stations
    assert {station["state"] for station in document["stations"]} == {"OP"}
    assert all(station["discarded"] == {} for station in document["stations"])
    rows = list(subscriptions(document))
    assert len(rows) == 26 + 28
    for rx in rows:
        assert troubles(rx) == (0, 0, 0)
        assert rx["discarded"] == {}
        assert rx["state"] == "running"
        assert rx["received"] > DURATION_S * 100 * 0.9
    processes = document["processes"]
    assert processes["engine"]["restarts"] == processes["services"]["restarts"] == 0
    assert processes["engine"]["rss"] <= 60 << 20
    assert_shape(document)

    start = time.monotonic()
    assert appliance.stop() == (0, "", "")
    assert time.monotonic() - start < 2


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
