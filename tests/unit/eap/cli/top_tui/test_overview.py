"""The live overview, by keys, on screens of several sizes."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from textual.binding import Binding
from textual.events import Key

from eap.cli.top_tui.app import TopApp
from eap.cli.top_tui.overview import OverviewScreen
from tests.support.liveviews import top_app
from tests.support.screens import Screen, play
from tests.support.statusdocument import bus_port, document, rx, tx


def plant(second: int) -> dict[str, Any]:
    """Return a plant of two stations, one of which loses a PD a second."""
    cycle = 1000 + 100 * second
    figures = {"cycle": cycle, "overruns": 0, "lateness_us": {"p50": 20, "p99": 80, "max": 99}}
    facts = {"source": "10.0.0.2", "frame": "to-right"}
    lossy = document(
        **figures,
        tx=[tx("out", sent=cycle, **facts)],
        rx=[rx("left", received=cycle, lost=second, **facts)],
        ports=[bus_port()],
    )
    other = document(**figures, name="press", state="PREOP")
    return lossy | {"stations": lossy["stations"] + other["stations"]}


async def wait(screen: Screen, text: str) -> str:
    """Return the screen once it has a text."""
    for _ in range(500):
        shown = await screen.settle_screen()
        if text in shown:
            return shown
    raise AssertionError(f"{text!r} is not on the screen:\n{shown}")


async def refresh(screen: Screen) -> str:
    """Have the view take another report, as a change of its period does."""
    await screen.pilot.press("minus")
    return await wait(screen, "")


def run(script: Any, size: tuple[int, int] = (80, 24)) -> None:
    play(top_app(plant), script, size, is_virtual=True)


@pytest.mark.parametrize("size", [(80, 24), (160, 50), (60, 15)])
def test_overview_fits_the_screen(size: tuple[int, int]) -> None:
    async def script(screen: Screen) -> None:
        await wait(screen, "mixer")
        await refresh(screen)
        lines = (await wait(screen, "in 100/s")).splitlines()
        assert len(lines) == size[1]
        assert all(len(line) <= size[0] for line in lines)
        assert lines[0].startswith(" line: 1/2 OP  in 100/s  out 100/s  lost 1  late 0")
        assert lines[1].startswith(" 1 Stations  2 PDs  3 Buses  4 Routes  5 Events")
        assert lines[2].split()[:6] == ["Station", "State", "Tx/s", "Rx/s", "Lost", "Late"]
        assert lines[3].split()[:6] == ["mixer", "OP", "100", "100", "1", "0"]
        assert lines[4].split()[:2] == ["press", "PREOP"]
        assert "Filter" in lines[-1]

    run(script, size)


def test_station_has_its_faults_and_pds_as_details() -> None:
    async def script(screen: Screen) -> None:
        shown = await wait(screen, "mixer  5.1.1.1.1.1")
        assert "cycle 10.0 ms, late by 20 µs (p99 80 µs)" in shown
        assert "mixer/bus0: press" in shown
        assert "press  5.1.1.1.1.1" in await screen.press_key("down")

    run(script, (80, 40))


def test_keys_choose_views_and_enter_goes_to_the_pds_of_a_station() -> None:
    async def script(screen: Screen) -> None:
        await wait(screen, "mixer")
        shown = await screen.press_key("2")
        assert "left" in shown
        assert "out sent by mixer/eap0" in shown
        assert "frame to-right; sent: 9 cycle; skipped: 0" in shown
        shown = await screen.press_key("3")
        assert "1002 press" in shown
        assert "is lost" in shown
        assert "mixer/bus0: press" in await screen.press_key("5")
        await screen.press_key("1")
        assert "Filter: station=mixer" in await screen.press_key("enter")
        shown = await screen.press_key("escape")
        assert "Filter:" not in shown.splitlines()[1]
        assert "Last minute" in shown
        assert " PD " in (await screen.press_key("tab")).splitlines()[2]

    run(script)


def test_filter_shows_rows_that_fit_and_says_why_none_does() -> None:
    async def script(screen: Screen) -> None:
        await wait(screen, "mixer")
        await screen.press_key("slash")
        for key in "pre":
            shown = await screen.press_key(key)
        assert "press" in shown
        assert "mixer   " not in shown
        await screen.press_key("enter")
        await screen.press_key("escape")
        await screen.press_key("slash")
        for key in ("l", "s", "t", "greater_than_sign", "0"):
            shown = await screen.press_key(key)
        assert "filter: no key 'lst', did you mean lost?" in shown

    run(script)


def test_keys_behind_the_slash_are_for_the_filter_however_fast() -> None:
    async def script(screen: Screen) -> None:
        await wait(screen, "mixer")
        for key, sign in (("slash", "/"), ("z", "z"), ("greater_than_sign", ">"), ("2", "2")):
            screen.app.post_message(Key(key, sign))
        shown = await wait(screen, "Filter: z>2")
        assert "since" not in shown.splitlines()[0]
        assert "Last minute" in shown

    run(script)


def test_event_is_shown_before_the_next_refresh_is_due() -> None:
    def report(second: int) -> dict[str, Any]:
        found = plant(0)
        found["stations"][1]["state"] = "OP" if second else "PREOP"
        return found

    async def script(screen: Screen) -> None:
        await wait(screen, "1/2 OP")
        began_s = asyncio.get_running_loop().time()
        await wait(screen, "press: state PREOP → OP")
        # At the first look; the first refresh is due after 10 s.
        assert asyncio.get_running_loop().time() - began_s < 9

    play(top_app(report, period_s=10.0), script, is_virtual=True)


def test_faults_of_the_appliance_are_details_of_its_stations() -> None:
    findings = [
        {"severity": "warning", "where": "recording day", "what": "recording, 3 lost"},
        {"severity": "info", "where": "recording night", "what": "armed, 3 variables"},
        {"severity": "info", "where": "clock", "what": "of no concern"},
    ]

    async def script(screen: Screen) -> None:
        shown = await wait(screen, "mixer  5.1.1.1.1.1")
        assert "recording day: recording, 3 lost" in shown
        assert "recording night: armed, 3 variables" in shown
        assert "clock: of no concern" not in shown

    found = plant(0)
    found["appliances"][0]["findings"] = findings
    play(top_app(lambda _: found), script, (80, 40), is_virtual=True)


def test_view_that_only_shows_records_nothing() -> None:
    async def script(screen: Screen) -> None:
        await wait(screen, "mixer")
        assert "start it with --write to change routes and to" in await screen.press_key("r")

    run(script)


def test_keys_sort_pause_and_count_from_now() -> None:
    async def script(screen: Screen) -> None:
        await wait(screen, "mixer")
        assert "Station▼" in await screen.press_key("greater_than_sign")
        shown = await screen.press_key("o")
        assert shown.splitlines()[3].startswith("press")
        assert "Station▲" in shown
        await screen.press_key("o")
        assert "▼" not in await screen.press_key("less_than_sign")
        await refresh(screen)
        await wait(screen, "lost 1")
        shown = await screen.press_key("z")
        assert "lost 0" in shown
        assert "since " in shown.splitlines()[0]
        assert "PAUSED" in await screen.press_key("space")
        await refresh(screen)
        assert "PAUSED" not in await screen.press_key("space")
        await wait(screen, "lost 1")
        assert "since" not in (await screen.press_key("Z")).splitlines()[0]

    run(script)


def test_events_below_the_table_say_what_happens() -> None:
    async def script(screen: Screen) -> None:
        await wait(screen, "mixer")
        await refresh(screen)
        assert "mixer: 1 lost: left" in await wait(screen, "lost: left")

    run(script)


def test_help_explains_the_keys_and_q_quits() -> None:
    async def script(screen: Screen) -> None:
        await wait(screen, "mixer")
        shown = await screen.press_key("question_mark")
        assert "1 to 5" in shown
        assert "Close (esc)" in shown
        await screen.press_key("escape")
        await screen.pilot.press("q")
        assert not screen.app.is_running or screen.app._exit

    run(script)


def test_appliance_that_is_gone_keeps_its_rows() -> None:
    app = top_app(lambda second: plant(second) if second < 2 else plant(2) | {"stations": []})

    async def script(screen: Screen) -> None:
        await wait(screen, "mixer")
        await refresh(screen)
        app._live.unreachable = {"line": "has ended: waiting for it to run again"}
        await refresh(screen)
        shown = await wait(screen, "gone")
        assert "line does not answer" in shown.splitlines()[0]
        assert "line: has ended: waiting for it to run again" in shown

    play(app, script, is_virtual=True)


def test_page_explains_every_key() -> None:
    page = Path("docs/top.md").read_text()
    bindings = [*TopApp.BINDINGS, *OverviewScreen.BINDINGS]
    names = {"slash": "/", "less_than_sign": "<", "greater_than_sign": ">", "plus": "+",
             "minus": "-", "question_mark": "?", "tab": "Tab", "f1": "F1"}  # fmt: skip
    for binding in bindings:
        assert isinstance(binding, Binding)
        for key in binding.key.split(","):
            if key in {"equals_sign", "ctrl+c"}:  # plus without shift, and what ends any program
                continue
            shown = names.get(key, key)
            assert any(form in page for form in (f"`{shown}`", f"| {shown} |", f", {shown} |")), key
