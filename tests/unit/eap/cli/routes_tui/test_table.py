from __future__ import annotations

import msgspec
import pytest

from eap.cli.routes_tui.table import PlantRouter, View, columns_of, detail, lines
from eap.cli.top_tui.grid import cut, fit
from tests.support.fakeroutes import ISLAND, FakeRoutes

ROUTER = PlantRouter("line", FakeRoutes().stations["island-01"])


def widths(view: View, width: int, *, has_station: bool = True) -> dict[str, int]:
    fitted = fit(columns_of(view, has_station=has_station), lines(view, [ROUTER], ""), width)
    return {column.heading: size for _, column, size in fitted}


def test_columns_are_as_wide_as_they_need_to_be() -> None:
    found = widths(View.ROUTES, 80)
    assert found == {
        "Station": 9, "Route": 9, "NetID": 13, "Transport": 9, "State": 5, "RTT": 7, "Reqs": 5,
        "Bytes": 6, "Errors": 6,
    }  # fmt: skip
    assert sum(found.values()) + len(found) <= 80


def test_wide_screens_show_columns_that_narrow_ones_omit() -> None:
    found = widths(View.ROUTES, 150)
    assert [*found][-3:] == ["Address", "Origin", "Last error"]
    assert found["Address"] == len("192.168.1.5:48898")
    assert sum(found.values()) + len(found) == 150
    assert "Station" not in widths(View.ROUTES, 80, has_station=False)


@pytest.mark.parametrize("view", View)
@pytest.mark.parametrize("width", [40, 72, 80, 100, 200])
def test_long_texts_are_cut_to_their_minimum(view: View, width: int) -> None:
    names = msgspec.structs.replace(
        ISLAND, name="a name that is much too long", transport="ethernet:an-interface"
    )
    routes = msgspec.structs.replace(ROUTER.routes, station="station-of-cell-17", routes=[names])
    found = lines(view, [ROUTER._replace(routes=routes)], "")
    fitted = fit(columns_of(view, has_station=True), found, width)
    assert sum(size + 1 for _, _, size in fitted) <= width


def test_columns_are_left_out_on_narrow_screens_before_names_are_cut() -> None:
    found = widths(View.ROUTES, 60)
    assert found == {"Station": 9, "Route": 9, "NetID": 13, "State": 5, "RTT": 7, "Errors": 6}


@pytest.mark.parametrize(
    ("text", "is_number", "shown"),
    [("12", True, "   12"), ("abc", False, "abc"), ("abcdef", False, "abcd…")],
)
def test_texts_are_cut(text: str, shown: str, *, is_number: bool) -> None:
    assert cut(text, 5, is_number=is_number) == shown


def test_connections_and_warnings_are_filtered_here() -> None:
    assert len(lines(View.CONNECTIONS, [ROUTER], "40112")) == 1
    assert lines(View.CONNECTIONS, [ROUTER], "nobody") == []
    assert len(lines(View.WARNINGS, [ROUTER], "PRESS")) == 1
    assert len(lines(View.ROUTES, [ROUTER], "nobody")) == 2  # the appliance did that


def test_detail_of_a_route() -> None:
    island, press = (detail(line) for line in lines(View.ROUTES, [ROUTER], ""))
    assert [text.partition("127")[0] for text, _ in island] == [
        "island-02  ", "derived; up: round trip 840 µs",
        "12 requests, 12 answers, 0 errors; bytes: 1234 out, 45.7k in", island[3][0][:9] + "READ ",
    ]  # fmt: skip
    assert press[1] == ("added; down: connection refused", "down")
    assert press[4][0].startswith("route press (5.1.2.3.1.1) is not taken")
    assert press[5][0].endswith("failed: press is down")


def test_detail_of_others() -> None:
    (tool,) = lines(View.CONNECTIONS, [ROUTER], "")
    assert detail(tool)[:2] == [
        ("127.0.0.1:40112#3 by ams-tcp", "bold"), ("requests from 127.0.0.1.1.1", "")
    ]  # fmt: skip
    assert len(detail(tool)) == 6
    quiet = tool._replace(row=msgspec.structs.replace(tool.row, net_ids=[], last_error=""))
    assert detail(quiet)[1] == ("no requests yet", "")
    (warning,) = lines(View.WARNINGS, [ROUTER], "")
    assert detail(warning) == [(ROUTER.routes.warnings[0], "down")]
    assert detail(None) == []
