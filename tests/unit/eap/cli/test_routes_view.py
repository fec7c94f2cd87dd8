from __future__ import annotations

import msgspec
from rich.console import Console

from eap.cli import routes_view
from eap.cli.routes_view import (
    import_table,
    neighbour_table,
    result_table,
)
from eap.cli.routes_view import (
    routes_view as view_of,
)
from eap.control.routes import (
    ImportRow,
    InterruptionRow,
    NeighbourRow,
    TestResult,
)
from eap.ops.routing import RouterList, TestedTarget
from tests.support.fakeroutes import FakeRoutes


def shown(*parts: object) -> str:
    console = Console(width=100, highlight=False)
    with console.capture() as capture:
        for part in parts:
            console.print(part)
    return capture.get()


def test_tables_of_routes_and_connections() -> None:
    text = shown(*view_of(RouterList(list(FakeRoutes().stations.values()))))
    rows = [line.split() for line in text.splitlines()]
    assert ["island-02", "none"] in rows
    assert ["press", "5.1.2.3.1.1", "ams-tcp", "192.168.1.5:48898", "down", "3", "3"] in rows
    assert ["island-01", "127.0.0.1:40112#3", "ams-tcp", "127.0.0.1.1.1", "75", "s", "15",
            "47.3k", "3"] in rows  # fmt: skip
    remarks = text.partition("Warnings\n")[2].splitlines()
    assert [each.strip().partition(":")[2][:22] for each in remarks] == [
        " route press (5.1.2.3.", " press (192.168.1.5:48", " press, last error: pr",
        " 127.0.0.1:40112#3 by ",
    ]  # fmt: skip


def test_routes_list_names_the_age_of_the_last_error() -> None:
    (press,) = (each for each in FakeRoutes().stations["island-01"].routes if each.name == "press")
    station = msgspec.structs.replace(
        FakeRoutes().stations["island-02"],
        routes=[msgspec.structs.replace(press, last_error="refused", last_error_s=300)],
    )
    assert "press, last error, 5 min ago: refused" in shown(*view_of(RouterList([station])))


def test_stations_that_are_well_have_no_remarks() -> None:
    quiet = FakeRoutes().stations["island-02"]
    assert "Warnings" not in shown(*view_of(RouterList([quiet])))
    assert "Connection" not in shown(*view_of(RouterList([quiet])))


def test_routes_name_subscriptions_that_are_interrupted() -> None:
    row = InterruptionRow(
        client="127.0.0.1:40112#3 by ams-tcp", source="127.0.0.1.1.1:32905",
        target="127.0.1.2.2.1:65535", count=20, since_s=12, why="island-02 is down",
    )  # fmt: skip
    station = msgspec.structs.replace(FakeRoutes().stations["island-02"], interruptions=[row])
    text = " ".join(shown(*view_of(RouterList([station]))).split())
    assert (
        "island-02: 20 subscriptions are interrupted, of 127.0.0.1.1.1:32905"
        " (127.0.0.1:40112#3 by ams-tcp) at 127.0.1.2.2.1:65535: island-02 is down, for 12 s"
    ) in text
    assert "20 subscriptions interrupted" in routes_view.summary([station])


def test_results() -> None:
    ok = TestResult(target="1.1.1.1.1.1:10000", name="a", ok=True, rtt_us=840, text="answers: RUN")
    bad = TestResult(target="2.1.1.1.1.1:10000", name="", ok=False, text="down", hint="look there")
    text = " ".join(
        shown(*result_table([TestedTarget.of("mixer", each) for each in (ok, bad)])).split()
    )
    assert "mixer a 1.1.1.1.1.1:10000 840 µs answers: RUN" in text
    assert "mixer 2.1.1.1.1.1:10000 down look there" in text


def test_imports() -> None:
    rows = [
        ImportRow(name="a", net_id="1.1.1.1.1.1", via="ams-tcp:a"),
        ImportRow(name="b", net_id="", via="", reason="no NetID"),
    ]
    text = shown(*import_table(rows, is_done=True))
    assert "Added" in text
    assert ["a", "1.1.1.1.1.1", "ams-tcp:a", "yes"] in [each.split() for each in text.splitlines()]
    assert "b" in text
    assert "no NetID" in text
    assert "Would be added" in shown(*import_table(rows, is_done=False))


def test_routers_of_other_hosts() -> None:
    cx = NeighbourRow(
        station="left", name="cx", net_id="5.1.2.3.1.1", address="10.0.0.5", version="3.1.4024",
        route="cx", is_learned=True,
    )  # fmt: skip
    lone = msgspec.structs.replace(cx, name="pc", version="", route="", is_learned=False)
    rows = [line.split() for line in shown(*neighbour_table([cx, lone])).splitlines()]
    assert ["left", "cx", "5.1.2.3.1.1", "10.0.0.5", "3.1.4024", "cx", "(auto-discovered)"] in rows
    assert ["left", "pc", "5.1.2.3.1.1", "10.0.0.5", "none"] in rows


def test_routes_by_a_hop_that_is_down_are_one_remark() -> None:
    station = FakeRoutes().stations["island-01"]
    (press,) = (each for each in station.routes if each.name == "press")
    down = msgspec.structs.replace(press, name="saw", net_id="5.1.2.4.1.1", last_error="")
    rows = [msgspec.structs.replace(each, next_name="press") for each in (down, press)]
    text = " ".join(
        shown(*view_of(RouterList([msgspec.structs.replace(station, routes=rows)]))).split()
    )
    assert (
        "press (192.168.1.5:48898 by ams-tcp) is down: connection refused;"
        " so are the routes through it:"
        " saw" in text
    )
    assert "saw (192" not in text
    assert routes_view.route_state(rows[0]) == "down: press: connection refused"
