from __future__ import annotations

from datetime import datetime

import msgspec
import pytest

from eap.cli import routes_view
from tests.support.fakeroutes import ISLAND, PRESS, READ, REFUSED, TOOL, FakeRoutes

AT = datetime.fromtimestamp(READ.at).astimezone().strftime("%H:%M:%S")


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (0, "0"), (9999, "9999"), (10_000, "10.0k"), (99_949, "99.9k"), (99_951, "100k"),
        (9_999_499, "9999k"), (12_345_678, "12.3M"), (10**17, "100P"),
    ],
)  # fmt: skip
def test_counts_have_five_characters(number: int, text: str) -> None:
    assert routes_view.short(number) == text


def test_elapsed_times_are_whole_seconds_up_to_two_minutes() -> None:
    assert [routes_view.elapsed(each) for each in (0, 119, 180, 7200)] == [
        "0 s",
        "119 s",
        "3 min",
        "2 h",
    ]


def test_kinds_and_states() -> None:
    assert routes_view.route_kind(ISLAND) == "derived"
    special = msgspec.structs.replace(
        ISLAND, origin="learned", expires_s=61, unidirectional=True, probed=False, timeout_ms=900,
        real="9.1.1.1.1.1",
    )  # fmt: skip
    assert routes_view.route_kind(special) == (
        "learned, ends in 61 s, unidirectional, not probed, real NetID 9.1.1.1.1.1,"
        " answers within 900 ms"
    )
    assert routes_view.route_state(PRESS) == "down: connection refused"
    new = msgspec.structs.replace(ISLAND, state="unknown", rtt_us=None)
    assert routes_view.route_state(new) == "unknown: no request answered yet"
    silent = msgspec.structs.replace(ISLAND, rtt_us=None)
    assert routes_view.route_state(silent) == "up"


def test_requests_on_a_line() -> None:
    assert routes_view.request_line(READ) == (
        f"{AT} READ 127.0.1.2.2.1:65535 < 127.0.0.1.1.1:32905: 1.2 ms"
    )
    assert routes_view.request_line(REFUSED).endswith(": failed: press is down")
    error = msgspec.structs.replace(READ, error=6)
    assert routes_view.request_line(error).endswith(": error 0x6")
    broken = msgspec.structs.replace(READ, outcome="dropped", service="", text="too short")
    assert routes_view.request_line(broken) == f"{AT} dropped: too short"


def test_requests_belong_to_routes_and_connections() -> None:
    default = msgspec.structs.replace(PRESS, octets=0)
    assert routes_view.belongs(READ, ISLAND)
    assert not routes_view.belongs(REFUSED, ISLAND)
    assert routes_view.belongs(REFUSED, PRESS)
    assert routes_view.belongs(msgspec.structs.replace(REFUSED, target="9.9.9.9.1.1:1"), default)
    assert not routes_view.belongs(msgspec.structs.replace(REFUSED, target="5.1.2.3.1.2:1"), PRESS)
    assert routes_view.belongs(READ, TOOL)
    assert not routes_view.belongs(msgspec.structs.replace(READ, came_by=""), TOOL)


def test_patterns() -> None:
    patterns = [msgspec.structs.replace(ISLAND, octets=each).pattern for each in (0, 4, 5, 6)]
    assert patterns == ["default", "127.0.1.2.*.*", "127.0.1.2.1.*", "127.0.1.2.1.1"]


def test_summary() -> None:
    stations = list(FakeRoutes().stations.values())
    assert routes_view.summary(stations) == "2 routes, 1 down, 1 connection, 1 warning"
    assert routes_view.summary(stations[1:]) == "0 routes, 0 connections"
