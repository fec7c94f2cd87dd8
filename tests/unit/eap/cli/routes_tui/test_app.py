"""The live view, by keys and mouse, on a screen of 80 columns and 24 lines."""

from __future__ import annotations

from contextlib import ExitStack
from threading import Event

import msgspec
import pytest

from eap.cli.routes_tui import app
from eap.cli.routes_tui.table import RouterClient
from tests.support.controlstub import ControlStub
from tests.support.fakeroutes import ISLAND, PRESS, FakeRoutes
from tests.support.liveviews import routes_app
from tests.support.screens import Screen, play
from tests.support.statusdocument import document

SIZE = 80, 24


@pytest.fixture
def fake():
    return FakeRoutes()


@pytest.fixture
def stub(fake, runtime):
    with ExitStack() as stack:
        yield ControlStub("line", list(fake.stations), fake.table(), stack)


def run(script, size=SIZE):
    play(routes_app(RouterClient(None)), script, size)


async def look(screen: Screen) -> str:
    screen.app.screen.fetch()
    return await screen.settle()


def test_everything_fits_80_by_24(stub):
    async def script(screen):
        shown = screen.text().splitlines()
        assert len(shown) == 24
        assert shown[0] == " line, 2 stations: 2 routes, 1 down, 1 connection, 1 warning"
        assert shown[1] == " r Routes 2  c Connections 1  w Warnings 1  s all stations"
        assert shown[2].split() == [
            "Station", "Route", "NetID", "Transport", "State", "RTT", "Reqs", "Bytes", "Errors"
        ]  # fmt: skip
        assert shown[3].split() == [
            "island-01", "island-02", "127.0.1.2.*.*", "udp:eap0", "up", "840", "µs", "12",
            "46.9k", "0",
        ]  # fmt: skip
        assert shown[16] == " island-02  127.0.1.2.*.*  127.0.1.2:34980 by udp:eap0"
        assert shown[17] == " derived; up: round trip 840 µs"
        assert "READ 127.0.1.2.2.1:65535 < 127.0.0.1.1.1:32905: 1.2 ms" in shown[19]
        assert shown[23] == "a Add e Edit d Remove t Test / Filter ? Help 1-5 View q Quit"

    run(script)


def test_everything_fits_60_by_15(stub):
    async def script(screen):
        shown = screen.text().splitlines()
        assert len(shown) == 15
        assert shown[1] == " r Routes 2  c Connections 1  w Warnings 1  s all stations"
        assert shown[2].split() == ["Station", "Route", "NetID", "State", "RTT", "Errors"]
        assert shown[3].split() == [
            "island-01", "island-02", "127.0.1.2.*.*", "up", "840", "µs", "0"
        ]  # fmt: skip
        assert shown[14] == "a Add e Edit d Remove t Test / Filter ? Help 1-5 View q Quit"
        assert not any("…" in line for line in shown[1:8])

    run(script, (60, 15))


@pytest.mark.parametrize("key", ["question_mark", "f1"])
@pytest.mark.parametrize("size", [(80, 24), (60, 15)])
def test_keys_are_explained(stub, key, size):
    async def script(screen):
        shown = await screen.press(key)
        for words in ("? F1     this help", "r c w    show routes, connections, warnings"):
            assert words in shown
        assert "this help" not in await screen.press("escape")

    run(script, size)


def test_cursor_shows_the_details_of_its_row(stub):
    async def script(screen):
        shown = await screen.press("down")
        assert " added; down: connection refused\n" in shown
        assert " last error: press (192.168.1.5:48898 by ams-tcp): connection refused" in shown
        assert " route press (5.1.2.3.1.1) is not taken: plc (5.1.2.3.1.1) is before it" in shown

    run(script)


def test_figures_move_and_the_cursor_stays_on_its_row(stub, fake):
    async def script(screen):
        await screen.press("down")
        later = msgspec.structs.replace(PRESS, requests=17)
        fake.set_routes("island-01", ISLAND, later)
        assert "17 requests" in await look(screen)
        new = msgspec.structs.replace(PRESS, name="new", net_id="9.1.1.1.1.1")
        fake.set_routes("island-01", new, ISLAND, later)
        shown = await look(screen)
        assert "9.1.1.1.1.1" in shown
        assert " press  5.1.2.3.1.1  192.168.1.5:48898" in shown
        fake.set_routes("island-01")
        assert "0 routes, 1 connection" in await look(screen)

    run(script)


def test_connections_and_warnings(stub):
    async def script(screen):
        shown = await screen.press("c")
        assert "127.0.0.1:40112#3 ams-tcp   127.0.0.1.1.1   75 s    15  47.3k      3" in shown
        assert " requests from 127.0.0.1.1.1\n" in shown
        shown = await screen.press("w")
        assert "island-01 route press (5.1.2.3.1.1) is not taken" in shown
        assert "RTT" in await screen.click("#views", offset=(3, 0))
        assert "75 s" in await screen.click("#views", offset=(15, 0))

    run(script)


def test_stations_one_by_one(stub):
    async def script(screen):
        shown = await screen.press("s")
        assert shown.startswith(" line, island-01: 2 routes")
        assert "Station" not in shown.splitlines()[2]
        assert (await screen.press("s")).startswith(" line, island-02: 0 routes")
        assert (await screen.press("s")).startswith(" line, 2 stations")

    run(script)


def test_filter(stub):
    async def script(screen):
        shown = await screen.press("slash")
        assert "show only what has this in it" in shown
        shown = await screen.write("press")
        assert "Filter: press" in shown
        assert "udp:eap0" not in shown
        shown = await screen.press("enter")
        assert "\npress" not in shown
        await screen.press("c")
        assert "\nisland-01" not in await screen.press("slash", "x")
        await screen.press("escape")
        assert "udp:eap0" in await screen.press("r")

    run(script)


def test_routes_test_shows_fault_and_remedy(stub):
    async def script(screen):
        shown = await screen.press("t")
        assert "island-01 to island-02" in shown
        assert "127.0.1.2.1.1:10000 in 840 µs: answers: RUN" in shown
        shown = await screen.press("escape", "down", "enter")
        assert "down: connection refused" in shown
        assert "see whether it is switched on" in shown
        shown = await screen.press("q", "c", "t")
        assert "Choose a route first." in shown

    run(script)


def test_test_that_is_refused(stub, fake):
    async def script(screen):
        fake.set_routes("island-01")
        assert "no route '127.0.1.2.1.1'" in await screen.press("t")
        fake.set_routes("island-01", msgspec.structs.replace(ISLAND, octets=0))
        await screen.press("escape")
        await look(screen)
        assert "leads to no station of its own" in await screen.press("t")

    run(script)


def test_route_is_added(stub, fake):
    async def script(screen):
        shown = await screen.press("a")
        assert "New route of island-01" in shown
        await screen.write("plc")
        await screen.press("tab")
        await screen.write("6.1.2.3.1.1")
        await screen.press("tab")
        await screen.write("nowhere")
        shown = await screen.press("enter")
        assert "via 'nowhere' is no port of the plant" in shown
        await screen.press(*["backspace"] * 7)
        await screen.write("ams-tcp:10.0.0.6")
        shown = await screen.press("ctrl+s")
        assert "3 routes" in shown
        assert "6.1.2.3.*.*" in shown

    run(script)
    added = fake.stations["island-01"].routes[-1]
    assert (added.name, added.address, added.octets) == ("plc", "10.0.0.6", 4)


def test_form_shows_the_reason_of_a_refused_route(stub):
    async def script(screen):
        await screen.press("a")
        await screen.write("shadow")
        await screen.press("tab", "tab")
        await screen.write("udp:10.0.0.6")
        assert "route shadow is never taken" in await screen.press("enter")

    run(script)


def test_added_route_is_changed_and_others_are_not(stub, fake):
    async def script(screen):
        assert "follows from the ports in the plant file" in await screen.press("e")
        shown = await screen.press("escape", "down", "e")
        assert "Route press of island-01" in shown
        assert "ams-tcp:192.168.1.5:48898" in shown
        await screen.write("2")
        shown = await screen.press("ctrl+s")
        assert "press2" in shown
        assert "2 routes" in shown
        await screen.press("c")
        assert "Choose a route first." in await screen.press("e")

    run(script)
    assert [row.name for row in fake.stations["island-01"].routes] == ["island-02", "press2"]


def test_route_is_removed_after_a_confirmation(stub, fake):
    async def script(screen):
        shown = await screen.press("down", "d")
        assert "Remove route press (5.1.2.3.1.1, 192.168.1.5:48898 by ams-tcp)" in shown
        await screen.press("n")
        assert len(fake.stations["island-01"].routes) == 2
        await screen.press("d")
        assert "1 route, 1 connection" in await screen.click("#yes")
        shown = await screen.press("d", "y")
        assert "route island-02 follows from the plant file" in shown
        await screen.press("escape", "c")
        assert "Choose a route first." in await screen.press("d")

    run(script)


def test_appliance_goes_away_and_comes_back(runtime, fake):
    async def script(screen):
        assert "no appliance runs: start one with 'eapctl run PLANT'" in screen.text()
        with ExitStack() as stack:
            ControlStub("line", list(fake.stations), fake.table(), stack)
            assert "127.0.1.2.*.*" in await look(screen)
        shown = await look(screen)
        assert shown.startswith(" no appliance runs")
        assert "127.0.1.2.*.*" in shown  # what was last known
        shown = await screen.press("t")
        assert "no station island-01 runs" in shown
        await screen.press("escape")
        with ExitStack() as stack:
            ControlStub("line", list(fake.stations), fake.table(), stack)
            assert (await look(screen)).startswith(" line, 2 stations")
        assert "Nothing" not in await screen.press("a", "escape")

    run(script)


def test_nothing_to_work_with(runtime):
    async def script(screen):
        before = screen.text()
        assert await screen.press("a", "w", "r") == before
        assert "Choose a route first." in await screen.press("t")

    run(script)


def test_view_reports_an_appliance_that_hangs(stub, fake, monkeypatch):
    answer, goes_on = fake.table()["routes_list"], Event()

    def hang(params):
        assert goes_on.wait(20)
        return answer(params)

    monkeypatch.setattr(app, "STALE_AFTER_S", 0.0)

    async def script(screen):
        stub._methods["routes_list"] = hang
        screen.app.screen.fetch()
        screen.app.screen.fetch()
        await screen.pilot.pause()
        assert screen.text().startswith(" no answer for 0 s")
        goes_on.set()
        assert (await screen.settle()).startswith(" line, 2 stations")

    stub._methods = fake.table()
    run(script)


def test_view_refreshes_periodically(stub):
    app = routes_app(RouterClient("line"), period_s=0.1)

    async def script(screen):
        while len(stub.requests) < 4:
            await screen.pilot.pause(0.05)
        await screen.press("q")

    play(app, script)
    assert stub.requests[-1][0] == "routes_list"


def test_wide_screens_show_more(stub):
    async def script(screen):
        heading = screen.text().splitlines()[2].split()
        assert heading[-4:] == ["Address", "Origin", "Last", "error"]

    run(script, (150, 30))


@pytest.mark.parametrize("key", ["a", "e", "d"])
def test_view_that_only_shows_refuses_changes(stub, key):
    async def script(screen):
        assert "started without --write" in await screen.press(key)
        await screen.press("escape")

    play(routes_app(RouterClient(None), refusal="started without --write"), script)
    assert {method for method, _ in stub.requests} == {"routes_list"}


def test_numbers_lead_to_the_other_views_and_back(stub, fake):
    stub._methods = fake.table() | {"status": lambda _: document() | {"plant": "line"}}

    async def script(screen):
        await screen.pilot.press("1")
        shown = await screen.settle_screen()
        assert "1 Stations  2 PDs" in shown
        await screen.pilot.press("4")
        assert "r Routes 2" in await screen.settle_screen()

    run(script)
