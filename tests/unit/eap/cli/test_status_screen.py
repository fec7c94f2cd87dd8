from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from eap.cli.status import StatusScreen
from tests.support.statusdocument import NOW_S, bus_port, document, rx, tx, with_findings


def show(
    status: dict[str, Any], *, width: int = 80, height: int | None = None, **more: Any
) -> list[str]:
    stream = io.StringIO()
    console = Console(
        file=stream, width=width, height=height, force_terminal=height is not None,
        color_system=None, highlight=False, legacy_windows=False,
    )  # fmt: skip
    console.print(StatusScreen(with_findings(status), NOW_S, **more))
    return [line.rstrip() for line in stream.getvalue().splitlines()]


def plant(stations: int, **more: Any) -> dict[str, Any]:
    status = document(tx=[tx("state")], rx=[rx("left")], **more)
    (mixer,) = status["stations"]
    status["stations"] = [mixer | {"name": f"island-{n:02}"} for n in range(1, stations + 1)]
    status["appliances"][0]["stations"] = [each["name"] for each in status["stations"]]
    return status


def test_screen_of_a_plant_without_faults() -> None:
    slaves = [{"name": "a", "address": 1001, "state": "OP", "fault": ""}]
    port = bus_port(slaves=slaves, findings=[], lost=0)
    status = plant(2, ports=[port], overruns=2)
    status["processes"]["segments"] = {
        name: {"pid": 7, "cpu": 2.0, "rss": 20e6, "restarts": n} for n, name in enumerate("ab")
    }
    assert show(status) == [
        "line: no errors (2 stations, 4 PDs)",
        "",
        "Station    State  Links  Tx      Rx  Lost  Late  Dropped  Buses",
        "─" * 68,
        "island-01  OP     up      9  123400     0     0        0  bus0: 1 OP",
        "island-02  OP     up      9  123400     0     0        0  bus0: 1 OP",
        "",
        "line: supervisor 0 % 21 MB, engine 4 % 35 MB, services,",
        "      2 segments 4 % 40 MB restarted once",
        "eapctl status --full: each PD, port and bus, and 2 remarks",
    ]


def test_screen_of_one_plant_in_two_appliances_counts_each_finding_once() -> None:
    status = plant(2, discarded={"wrong_type": 3}, links_held=1)
    (whole,) = status["appliances"]
    names = ["island-01", "island-02"]
    status["appliances"] = [whole | {"stations": [name]} for name in names]
    lines = show(status)
    assert [line for line in lines if "PDs)" in line] == [
        "line: no errors, 2 warnings (2 stations, 4 PDs)"
    ]
    assert [line.split()[1] for line in lines if line.startswith("warning")] == [
        f"{name}:" for name in names
    ]
    assert [line.split(":")[0] for line in lines if "supervisor" in line] == [
        f"line ({name})" for name in names
    ]
    assert lines[-1] == "eapctl status --full: each PD, port and bus, and 2 remarks"


def test_screen_shows_errors_first_with_their_counts() -> None:
    status = document(
        rx=[rx("left", state="stale", lost=12, late=3, discarded={"version": 2})],
        state="OP", discarded={"wrong_type": 3}, links_held=1, ports=[bus_port()],
    )  # fmt: skip
    lines = show(status)
    assert lines[0] == "line: 2 errors, 1 warning (1 station, 1 PD)"
    assert lines[1].startswith("error    mixer/bus0: press (1002) is lost")
    assert lines[2] == " " * 9 + "details"
    assert lines[3].startswith("error    mixer ← left: stale: nothing received within")
    row = next(line for line in lines if line.startswith("mixer"))
    assert row.split()[:8] == ["mixer", "OP", "up", "0", "123400", "12", "3", "5"]
    assert row.endswith("bus0: 1 OP, 1 no answer")


def test_screen_names_links_that_are_down_and_slaves_that_do_not_answer() -> None:
    down = {"name": "eap0", "kind": "eap", "interface": "ethernet://eth0", "link": "down"}
    row = next(
        line for line in show(document(ports=[down, bus_port()]), width=100) if " OP " in line
    )
    assert "eap0 down" in row
    assert row.endswith("bus0: 1 OP, 1 no answer")


def test_screen_shows_rates_after_the_first_sample() -> None:
    before, after = plant(3, cycle=1000), plant(3, cycle=1200)  # of 10 ms
    for number, station in enumerate(after["stations"]):
        station["pd"] = {"tx": [tx("state", sent=209)], "rx": [rx("left", received=123_450)]}
        station["name"] = f"island-{number:02}"
    after["stations"][1]["pd"] = {"tx": [tx("state", sent=3)], "rx": [rx("left", received=1)]}
    rows = show(after, earlier=with_findings(before))[2:]
    assert rows[0].split()[3:5] == ["Tx/s", "Rx/s"]
    assert rows[2].split()[3:] == ["0", "0", "0"]  # a station that was not there before
    assert rows[3].split()[3:] == ["0", "0", "0"]  # its counters started anew
    assert rows[4].split()[3:] == ["100", "25", "0", "0", "0"]


def test_screen_takes_rates_from_the_time_of_the_station() -> None:
    before, after = plant(1, cycle=1000, overruns=3), plant(1, cycle=1180, overruns=23)
    after["stations"][0]["pd"] = {"tx": [tx("state", sent=109)], "rx": []}
    rows = show(after, earlier=with_findings(before))
    assert rows[4].split()[3] == "50"


@pytest.mark.parametrize(("width", "height"), [(80, 24), (60, 15), (120, 40)])
@pytest.mark.parametrize("stations", [3, 15, 60])
@pytest.mark.parametrize("faults", [0, 30])
def test_screen_of_a_terminal_is_never_exceeded(
    width: int, height: int, stations: int, faults: int
) -> None:
    status = plant(stations)
    status["appliances"][0]["findings"] = [
        {"severity": "error", "where": f"place-{n}", "what": "x " * 50} for n in range(faults)
    ]
    lines = show(status, width=width, height=height)
    assert max(map(len, lines)) <= width
    assert len(lines) < height
    assert "place-0" in "".join(lines[:3]) or not faults
    if stations == 60:
        assert any("more stations" in line and "in OP" in line for line in lines)
    shown = sum("place-" in line for line in lines)
    assert shown == faults or f"{faults - shown} more: eapctl status --full" in lines


def test_piped_screen_leaves_nothing_out() -> None:
    assert sum("island-" in line for line in show(plant(60), width=10_000)) == 60
