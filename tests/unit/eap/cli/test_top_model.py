"""Content of ``eapctl top``: rows of texts from reports."""

from __future__ import annotations

from typing import Any

import pytest

from eap.cli.top_model import COLUMNS, GONE, Tab, TopModel, sort_keys
from eap.live.events import LiveEvent
from eap.live.findings import Severity
from tests.support.liveviews import report
from tests.support.statusdocument import NOW_S, bus_port, document, rx, tx


def status(second: int, *, lost: int = 0, late: int = 0, **station: Any) -> dict[str, Any]:
    """Return a station that sends and receives 100 PDs a second, in cycles of 10 ms."""
    cycle = 1000 + 100 * second
    sent = [tx("out", sent=cycle)]
    received = [rx("left", received=cycle, lost=lost, late=late)]
    return document(**{"cycle": cycle, "overruns": 0, "tx": sent, "rx": received} | station)


def two_stations(second: int) -> dict[str, Any]:
    first, second_one = status(second, lost=second), status(second, name="press")
    return first | {"stations": first["stations"] + second_one["stations"]}


def after(*documents: dict[str, Any], **options: Any) -> TopModel:
    model = TopModel(**options)
    for second, each in enumerate(documents):
        model.take(report(each, second))
    return model


def cells(model: TopModel, tab: Tab = Tab.STATIONS, **more: Any) -> list[tuple[str, ...]]:
    return [line.cells for line in model.lines(tab, **more)]


def test_station_has_its_figures_in_a_line() -> None:
    model = after(status(0), status(1, lost=3, ports=[bus_port(findings=[])]))
    (line,) = model.lines(Tab.STATIONS, width=10)
    assert line.cells == (
        "mixer", "OP", "100", "100", "3", "0", "4.2 ms", "111 µs", "1/2 OP", "         !"
    )  # fmt: skip
    assert [line.style_of(number) for number in (1, 4, 8)] == ["green", "bold red", "bold red"]
    assert len(line.cells) == len(COLUMNS[Tab.STATIONS])
    assert model.head() == "line: 1/1 OP  in 100/s  out 100/s  lost 3  late 0"


def test_last_minute_shows_rates_troubles_and_silence() -> None:
    documents = [status(second) for second in range(8)]
    documents += [status(8, late=2), status(8, late=2)]  # the second time without a cycle
    model = after(*documents)
    (line,) = model.lines(Tab.STATIONS, width=60)
    assert line.cells[-1] == " " * 51 + "███████!·"


def test_counts_from_now_on_leave_the_total_as_it_is() -> None:
    model = after(status(0, lost=5))
    model.count_from_now()
    model.take(report(status(1, lost=7, late=1), 1))
    assert cells(model)[0][4:6] == ("2", "1")
    assert "lost 2  late 1" in model.head()
    model.since = None
    assert cells(model)[0][4:6] == ("7", "1")


def test_rows_are_sorted_by_a_column_and_turned_round() -> None:
    model = after(two_stations(0), two_stations(1))
    assert [row.name for row in model.stations()] == ["mixer", "press"]
    model.sort_key = "name"
    model.is_reversed = True
    assert [row.name for row in model.stations()] == ["press", "mixer"]
    model.sort_key, model.is_reversed = "lost", False
    assert [row.lost for row in model.stations()] == [1, 0]


@pytest.mark.parametrize("tab", [Tab.STATIONS, Tab.PDS, Tab.BUSES, Tab.EVENTS])
def test_every_column_can_be_sorted_by(tab: Tab) -> None:
    model = after(two_stations(0), two_stations(1) | {})
    events = [LiveEvent(NOW_S, Severity.ERROR, "line", "mixer", "what")]
    whole = sorted(cells(model, tab, events=events))
    for key in sort_keys(tab):
        model.sort_key = key
        assert sorted(cells(model, tab, events=events)) == whole


def test_filter_chooses_rows_and_a_wrong_one_is_refused() -> None:
    model = after(two_stations(0), two_stations(1), match="lost>0")
    assert [row.name for row in model.stations()] == ["mixer"]
    assert model.lines(Tab.PDS)[0].cells[:3] == ("mixer", "←", "left")
    assert "2/2 OP" in model.head()  # sums are those of all
    model.match = "lst>0"
    with pytest.raises(ValueError, match="did you mean lost"):
        model.lines(Tab.STATIONS)


def test_station_of_an_appliance_that_is_gone_stays_and_says_so() -> None:
    model = after(status(0), status(1))
    model.take(report(status(2) | {"stations": []}, 2, {"line": "has ended"}))
    assert cells(model)[0][:4] == ("mixer", GONE, "", "")
    assert "line does not answer" in model.head()
    model.take(report(status(3), 3))
    assert cells(model)[0][1] == "OP"


def test_pds_show_both_directions() -> None:
    sent, received = cells(after(status(0), status(1, lost=1)), Tab.PDS)
    assert sent[:8] == ("mixer", "→", "out", "", "100", "", "", "")
    assert received[:8] == ("mixer", "←", "left", "running", "100", "1", "0", "4.2 ms")


def test_buses_show_the_bus_and_its_slaves() -> None:
    model = after(status(0, ports=[bus_port()]))
    bus, drive, press = cells(model, Tab.BUSES)
    assert bus[:6] == ("mixer/bus0", "", "", "up", "3", "0")
    assert drive[:4] == ("mixer/bus0", "1001", "drive", "OP")
    assert (press[3], press[6]) == ("lost", "is lost")


def test_events_are_listed_with_the_latest_first() -> None:
    events = [LiveEvent(NOW_S + n, Severity.ERROR, "line", "mixer", f"event {n}") for n in (1, 2)]
    assert [row[1:] for row in cells(after(status(0)), Tab.EVENTS, events=events)] == [
        ("error", "mixer", "event 2"), ("error", "mixer", "event 1")
    ]  # fmt: skip


def test_without_an_appliance_the_head_says_how_to_start_one() -> None:
    model = TopModel()
    assert model.head() == "waiting for the first answer"
    assert model.lines(Tab.STATIONS) == []
    model.take(report(status(0) | {"stations": [], "appliances": []}))
    assert model.head().startswith("no appliance runs: start one with")


def test_faults_and_pds_of_a_station_are_its_details() -> None:
    received = [rx("good"), rx("bad", state="stale", lost=4)]
    model = after(status(0, rx=received, ports=[bus_port()]))
    assert [flow.name for flow in model.flows("line", "mixer")] == ["bad", "good", "out"]
    found = [text for text, _ in model.findings_of("mixer", "line")]
    assert any(text.startswith("mixer/bus0: press") for text in found)
    assert any("mixer ← bad: stale" in text for text in found)
