from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from eap.config.load import load
from eap.runtime.busfile import describe
from tools.demo import PLANT, SHOWN, WAYS, Endpoint, Look, RateMeter, as_line, as_screen


def look(at_s: float, received: int, **row: Any) -> Look:
    values: dict[str, dict[str, Any]] = {
        station: {shown.name: 1234.5678 for shown in variables}
        for station, variables in SHOWN.items()
    }
    values["island-01"] |= {"ticks": 4_000_000_000, "drive_enabled": True}
    values["island-02"]["left_ticks"] = 3_999_999_999
    counters = {
        "received": received, "lost": 12, "late": 345, "age_us": 22_900, "state": "running",
    }  # fmt: skip
    return Look(at_s, values, {way.key: counters | row for way in WAYS})


def lines(at: Look, rates: dict[Endpoint, float], width: int = 80) -> list[str]:
    console = Console(file=io.StringIO(), width=width, highlight=False)
    console.print(as_screen(at, rates))
    return [line.rstrip() for line in console.file.getvalue().splitlines()]  # type: ignore[attr-defined]


def test_demo_shows_variables_and_paths_of_its_plant() -> None:
    plant = load(PLANT, describe).plant
    assert plant is not None
    stations = {each.name: each for each in plant.stations}
    assert list(SHOWN) == list(stations)
    for name, shown in SHOWN.items():
        known = {each.name for each in stations[name].variables}
        assert {each.name for each in shown} <= known
    for way in WAYS:
        assert way.subscription in {each.name for each in stations[way.receiver].subscriptions}
        sent = {pd.name for frame in stations[way.sender].frames for pd in frame.pds}
        assert way.name in sent


def test_demo_screen_fits_80x24_and_does_not_move_with_its_values() -> None:
    small, large = (
        lines(look(1, 0, lost=0, late=0), {}),
        lines(look(99, 9), dict.fromkeys(WAYS, 50)),
    )
    for shown in (small, large):
        assert len(shown) < 24
        assert max(map(len, shown)) <= 80
    assert small[2:4] == large[2:4]
    assert [line.find("►") for line in small] == [line.find("►") for line in large]


@pytest.mark.parametrize(
    "page", ["open http://127.0.0.1:8080/ in a browser", "no page: " + "x" * 99]
)
def test_demo_screen_with_a_page_fits_80x24(page: str) -> None:
    console = Console(file=io.StringIO(), width=80, highlight=False)
    console.print(as_screen(look(1, 0), {}, page))
    shown = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert len(shown) < 24
    assert max(map(len, shown)) <= 80
    assert page[:40] in "".join(shown)


def test_demo_screen_shows_an_interrupted_path() -> None:
    assert sum("── x ──" in line for line in lines(look(1, 0, state="stale", age_us=None), {})) == 5


def test_demo_screen_of_a_narrow_terminal_leaves_out_stations() -> None:
    shown = lines(look(1, 0), {}, width=60)
    assert max(map(len, shown)) <= 60
    assert "not shown for lack of width: island-03" in shown


@pytest.mark.parametrize("rates", [{}, dict.fromkeys(WAYS, 5000.0)])
def test_demo_line_is_short(rates: dict[Endpoint, float]) -> None:
    assert len(as_line(look(100_000, 10**9), rates)) <= 110
    assert len(as_line(look(100, 1, late=0, lost=0), rates)) <= 100


def test_rate_meter_measures_over_about_a_second() -> None:
    meter = RateMeter()
    assert meter.rates(look(0.0, 0)) == {}
    for tick in range(1, 11):
        rates = meter.rates(look(tick / 2, tick * 25))
    assert set(rates.values()) == {50.0}
    assert meter.rates(look(5.5, 250))[WAYS[0]] == pytest.approx(25)
