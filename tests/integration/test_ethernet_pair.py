"""Two stations on one cable (config/ethernet-pair.yaml): nothing lost, and the truth when it is."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Appliance, Plants, troubles, wait_until
from tests.support.machine import slowness
from tests.support.namespaces import Namespace, cable

pytestmark = [pytest.mark.net, pytest.mark.root]

PLANT = Path(__file__).parents[2] / "config/ethernet-pair.yaml"
DURATION_S = 60 if os.environ.get("EAP_LONG") else 2
"""The full minute is for ``EAP_LONG=1``; the short run is as strict."""
TIMEOUT_MS = 10


@pytest.fixture(scope="module")
def ends() -> Iterator[tuple[Namespace, Namespace]]:
    with cable() as both:
        yield both


@pytest.fixture(scope="module")
def shared(module_farm: Plants, ends: tuple[Namespace, Namespace]) -> tuple[Appliance, Appliance]:
    left, right = (
        module_farm.start(PLANT, "--station", name, prefix=end.prefix)
        for name, end in zip(("left", "right"), ends, strict=True)
    )
    assert left.wait_ready() == ["left"]
    assert right.wait_ready() == ["right"]
    return left, right


@pytest.fixture
def pair(
    shared: tuple[Appliance, Appliance], ends: tuple[Namespace, Namespace]
) -> tuple[Appliance, Appliance]:
    """Return both stations, which hear each other."""
    ends[1].plug()
    left, right = shared
    for side, name in ((left, "left"), (right, "right")):
        wait_for_frames(side, name, side.rx(name, "peer")["received"] + 100)
        wait_until(lambda side=side, name=name: side.rx(name, "peer")["state"] == "running")
        wait_for_link(side, name, "up")
    return shared


def quiet(appliance: Appliance, station: str) -> dict[str, Any]:
    """Return the subscription once no more frames come: its counters fit each other exactly."""
    seen: list[dict[str, Any]] = []

    def is_calm() -> bool:
        seen.append(appliance.rx(station, "peer"))
        return len({rx["received"] for rx in seen[-20:]}) == 1 and len(seen) >= 20

    wait_until(is_calm)
    return seen[-1]


@pytest.mark.quiet
@pytest.mark.timeout(DURATION_S + 60)
def test_nothing_is_lost_at_one_millisecond(pair: tuple[Appliance, Appliance]) -> None:
    left, right = pair
    before = [left.rx("left", "peer"), right.rx("right", "peer")]
    restarts = [restarts_of(side.status()) for side in pair]
    time.sleep(DURATION_S)
    documents = [json.loads(side.command("status", "--json")) for side in pair]
    after = [document["stations"][0]["pd"]["rx"][0] for document in documents]
    for then, now in zip(before, after, strict=True):
        assert troubles(now) == troubles(then)
        # An engine that the host stops leaves cycles out; more than half a second is no plant.
        assert now["received"] - then["received"] > DURATION_S * 1000 * 0.75
        assert now["discarded"] == then["discarded"]  # stale ones, from before this end was ready
        assert now["state"] == "running"
    for document in documents:
        (station,) = document["stations"]
        assert set(station["discarded"]) <= {"stale"}
        assert station["pd"]["tx"][0]["skipped"] == 0
        assert station["ports"][0]["link"] == "up"
    assert [restarts_of(document) for document in documents] == restarts


def restarts_of(document: dict[str, Any]) -> list[int]:
    return [document["processes"][name]["restarts"] for name in ("engine", "services")]


def test_a_cable_is_cut_and_restored(
    pair: tuple[Appliance, Appliance], ends: tuple[Namespace, Namespace]
) -> None:
    left, right = pair
    pids = [side.status()["processes"] for side in pair]
    assert left.values("left")["peer.speed"] > 1000

    ends[1].unplug()
    cut = {"left": quiet(left, "left"), "right": quiet(right, "right")}
    for side, name in ((left, "left"), (right, "right")):
        missing = cut[name]["quality"] + 5000  # half a second in units of 100 us
        wait_until(lambda: side.rx(name, "peer")["quality"] > missing)  # noqa: B023  called at once
    for side, name in ((left, "left"), (right, "right")):
        # The kernel takes up to a second to tell that the other end of a cable is gone.
        wait_for_link(side, name, "down")
        assert_gone(side, name, cut[name])

    ends[1].plug()
    for side, name in ((left, "left"), (right, "right")):
        wait_for_frames(side, name, cut[name]["received"] + 300)
        assert side.values(name)["peer.speed"] > 1000
        assert side.rx(name, "peer")["quality"] < 10 * TIMEOUT_MS
        wait_for_link(side, name, "up")

    ends[1].unplug()
    for side, name in ((left, "left"), (right, "right")):
        now = quiet(side, name)
        assert_every_cycle_accounted(cut[name], now)
        assert now["lost"] - cut[name]["lost"] > 400  # of the half second, on a busy host, too
    for before, side in zip(pids, pair, strict=True):
        after = side.status()["processes"]
        assert [before[p]["pid"] for p in before] == [after[p]["pid"] for p in after]


def test_a_killed_engine_is_missed_for_its_true_length(
    pair: tuple[Appliance, Appliance], ends: tuple[Namespace, Namespace]
) -> None:
    left, right = pair
    (restarts, _) = restarts_of(left.status())
    ends[1].unplug()
    before = quiet(right, "right")
    ends[1].plug()
    wait_until(lambda: right.rx("right", "peer")["received"] > before["received"] + 100)
    busy = slowness()
    os.kill(left.pid("engine"), signal.SIGKILL)
    count = right.rx("right", "peer")["received"]
    took_s = wait_until(lambda: right.rx("right", "peer")["received"] > count + 20)
    assert took_s < 1.0 * max(busy, slowness())
    wait_until(lambda: left.rx("left", "peer")["state"] == "running")
    ends[1].unplug()
    assert_every_cycle_accounted(before, quiet(right, "right"))
    assert restarts_of(left.status())[0] == restarts + 1


def wait_for_link(appliance: Appliance, station: str, state: str) -> None:
    wait_until(lambda: appliance.station(station)["ports"][0]["link"] == state)


def wait_for_frames(appliance: Appliance, station: str, count: int) -> None:
    wait_until(lambda: appliance.rx(station, "peer")["received"] > count)


def assert_gone(side: Appliance, name: str, cut: dict[str, Any]) -> None:
    """Quality grows with time, and the substitute is in place."""
    station = side.station(name)
    (rx,) = station["pd"]["rx"]
    assert station["state"] == "OP"
    assert rx["state"] == "stale"
    assert rx["timeouts"] >= 1
    assert rx["quality"] > cut["quality"] + 4000
    assert abs(rx["quality"] * 100 - rx["age_us"]) < 100_000
    values = side.values(name)
    assert (values["peer.ticks"], values["peer.speed"]) == (0, 0)
    assert set(values["peer.recipe"]) == {"0"}


def assert_every_cycle_accounted(before: dict[str, Any], after: dict[str, Any]) -> None:
    """Between two moments of silence each sender cycle was received or counted as lost."""
    gone = (after["cycle_index"] - before["cycle_index"]) % 65536
    lost = after["lost"] - before["lost"]
    assert after["received"] - before["received"] + lost == gone
    assert lost > 0
    assert (after["duplicated"], after["reordered"]) == (0, 0)
