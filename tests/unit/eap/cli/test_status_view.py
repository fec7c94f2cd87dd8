"""Tables from a literal status document, in the shape that docs/control.md promises."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from eap.cli.status_view import status_tables


def rx(name: str, **more: Any) -> dict[str, Any]:
    row = {
        "name": name,
        "port": "eap0",
        "received": 123_400,
        "lost": 0,
        "duplicated": 0,
        "reordered": 0,
        "late": 0,
        "timeouts": 0,
        "discarded": {},
        "quality": 0,
        "age_us": 4200,
        "jitter_us": {"p50": 55, "p99": 111, "max": 2222},
        "state": "running",
    }
    return row | more


def tx(name: str, **more: Any) -> dict[str, Any]:
    row = {"name": name, "port": "eap0", "sent": 9, "skipped": 0, "reason": {"cycle": 9}}
    return row | more


def document(*, tx: list[Any] = [], rx: list[Any] = [], **station: Any) -> dict[str, Any]:  # noqa: B006
    processes: dict[str, Any] = {
        "supervisor": {"pid": 100, "cpu": 0.0, "rss": 21_000_000},
        "engine": {"pid": 101, "cpu": 4.25, "rss": 35_400_000, "realtime": {}, "restarts": 0},
        "services": {"pid": 102, "cpu": None, "rss": None, "restarts": 0},
    }
    port = {
        "name": "eap0",
        "kind": "eap",
        "net_id": "5.1.1.1.2.1",
        "interface": "udp://127.0.1.1",
        "link": "up",
    }
    mixer = {
        "name": "mixer",
        "net_id": "5.1.1.1.1.1",
        "state": "OP",
        "cycle_us": 10_000,
        "ports": [port],
        "discarded": {},
        "pd": {"tx": tx, "rx": rx},
    }
    stations = [mixer | station]
    appliance = {"plant": "line", "stations": ["mixer"], "processes": processes}
    return {
        "version": 1,
        "processes": processes,
        "stations": stations,
        "appliances": [appliance],
    }


def show(status: dict[str, Any], *, width: int = 100, color: bool = False) -> str:
    stream = io.StringIO()
    system = "standard" if color else None
    console = Console(file=stream, width=width, force_terminal=color, color_system=system)
    for part in status_tables(status):
        console.print(part)
    return stream.getvalue()


def row_of(text: str, word: str) -> str:
    return " ".join(next(line for line in text.splitlines() if word in line).split())


def test_processes_and_stations() -> None:
    text = show(document())
    assert row_of(text, "engine") == "engine process 101 4.2 % of a core 35 MB"
    assert row_of(text, "services") == "services process 102"
    assert row_of(text, "mixer") == "mixer OP 10.0 ms eap0 udp://127.0.1.1 5.1.1.1.2.1 up"
    assert "Worth a look" not in text


@pytest.mark.parametrize(
    ("state", "meaning"),
    [
        ("PREOP", "it exchanges no process data until 'eapctl state mixer OP'"),
        ("SAFEOP", "it receives no process data until 'eapctl state mixer OP'"),
    ],
)
def test_a_station_that_was_left_in_another_state(state: str, meaning: str) -> None:
    shown = show(document(state=state, tx=[tx("speed")], rx=[rx("left")]))
    assert ("→ speed off" in row_of(shown, "speed")) == (state == "PREOP")
    assert "← left off" in row_of(shown, "left")
    text = " ".join(shown.split())
    assert f"Worth a look mixer: in {state}, as was asked for last: {meaning}" in text


def test_process_that_was_restarted_and_one_that_is_being() -> None:
    status = document()
    status["processes"]["engine"]["restarts"] = 2
    status["processes"]["services"]["pid"] = None
    text = show(status)
    assert row_of(text, "engine").endswith("35 MB restarted 2 times")
    assert row_of(text, "services") == "services restarting"


def test_process_that_starts_is_shown_with_its_step() -> None:
    status = document()
    status["processes"]["engine"]["step"] = "building station mixer"
    shown = row_of(show(status), "engine")
    assert shown.endswith("starting: building station mixer")


def test_what_the_engine_was_denied() -> None:
    status = document()
    status["processes"]["engine"]["realtime"] = {
        "scheduler": "other: needs CAP_SYS_NICE",
        "cpus": [0, 1],
        "memory_locked": "needs CAP_IPC_LOCK",
        "pm_qos": True,
    }
    _, _, remarks = show(status).partition("Worth a look\n")
    assert [line.strip() for line in remarks.splitlines()] == [
        "line engine, scheduler: needs CAP_SYS_NICE",
        "line engine, memory locked: needs CAP_IPC_LOCK",
    ]


@pytest.mark.parametrize("scheduler", ["fifo 50", "other: not asked for"])
def test_engine_that_got_what_it_asked_for(scheduler: str) -> None:
    status = document()
    status["processes"]["engine"]["realtime"] = {"scheduler": scheduler, "pm_qos": True}
    assert "Worth a look" not in show(status)


def test_received_pds() -> None:
    silent = {"received": 0, "lost": None, "quality": None, "age_us": None, "state": "waiting"}
    silent["jitter_us"] = {"p50": None, "p99": None, "max": None}
    text = show(document(rx=[rx("left"), rx("quiet", **silent)]))
    assert row_of(text, "left") == "← left running 123400 0 0 4.2 ms 55 / 111 / 2222"
    assert row_of(text, "quiet") == "← quiet waiting 0 unknown"


def test_sent_pds() -> None:
    alarm = tx("alarm", reason={"change": 1, "change_timeout": 8}, last_reason="change_timeout")
    text = show(document(tx=[tx("state"), alarm, tx("mute", sent=0, reason={})]))
    assert row_of(text, "→  state") == "→ state cyclic 9"
    assert row_of(text, "→  alarm") == "→ alarm resend 9"
    assert row_of(text, "mute") == "→ mute silent 0"
    assert "mixer → alarm: sent on change once, resend 8 times" in text


def test_polled_pds_show_how_long_answers_took() -> None:
    times = {"last": 1700, "p50": 1791, "p99": 1877, "max": 1900}
    none = {"p50": None, "p99": None, "max": None}
    text = show(
        document(
            tx=[tx("part", reason={"poll": 9}, last_reason="poll")],
            rx=[rx("answer", lost=None, quality=17, jitter_us=none, response_us=times)],
        )
    )
    assert row_of(text, "part") == "→ part polled 9"
    assert (
        row_of(text, "answer") == "← answer running 123400 unknown 1.7 ms 4.2 ms 1791 / 1877 / 1900"
    )


def test_the_state_of_a_frame_is_worth_a_look_when_it_is_more_than_skipped() -> None:
    rows = [tx("a", skipped=2, frame_state=3), tx("b", frame_state=4), tx("c", frame_state=1)]
    text = show(document(tx=rows))
    assert "mixer → a: skipped 2 times; larger than its network carries" in text
    assert "mixer → b: nobody is there" in text
    assert "mixer → c" not in text


@pytest.mark.parametrize(("cycle_us", "hangs"), [(10_000, True), (1_000_000, False)])
def test_station_whose_engine_hangs(cycle_us: int, hangs: bool) -> None:
    text = show(document(cycle_us=cycle_us, cycle_age_us=3_100_000))
    assert ("mixer: has not run a cycle for 3.1 s" in text) is hangs


def test_values_that_no_link_passes_on_are_worth_a_look() -> None:
    assert "mixer: held 3 linked values back: no number" in show(document(links_held=3))
    assert "held" not in show(document(links_held=0))


def test_requests_to_buses_that_got_lost_are_worth_a_look() -> None:
    status = document()
    counts = {"malformed": 0, "dropped": 3}
    status["appliances"][0]["processes"]["engine"]["bus_requests"] = counts
    assert "engine, requests to buses: 3 dropped" in show(status)
    counts["dropped"] = 0
    assert "requests to buses" not in show(status)


def test_remarks_name_all_that_is_rare() -> None:
    left = rx(
        "left",
        timeouts=1,
        duplicated=2,
        reordered=3,
        late=4,
        discarded={"version": 5, "length": 6},
        source="10.0.0.1",
        wrong_source={"address": "10.0.0.9", "age_us": 2_000_000},
        other_source={"address": "10.0.0.8", "age_us": 3_000_000},
    )
    status = document(
        tx=[tx("state", skipped=7)],
        rx=[left],
        discarded={"unknown_id": 8},
        overruns=1,
        torn=2,
    )
    _, _, remarks = show(status).partition("Worth a look\n")
    first, second, *third = (line.strip() for line in remarks.splitlines())
    assert first == "mixer: left out 1 cycle; found 2 torn writes; turned away: 8 unknown id"
    assert second == "mixer → state: skipped 7 times"
    heading, _, reasons = " ".join(third).partition(": ")
    assert heading == "mixer ← left"
    assert reasons.split("; ") == [
        "timed out once",
        "2 duplicated",
        "3 reordered",
        "4 late",
        "discarded: 5 version, 6 length",
        "10.0.0.9 sends with this publisher ID, last 2.0 s ago: dropped",
        "two senders with this publisher ID: 10.0.0.1 and 10.0.0.8, last 3.0 s ago",
    ]


@pytest.mark.parametrize("width", [80, 100])
def test_tables_keep_their_width_and_lose_no_number(width: int) -> None:
    name = "island-01.production-state"
    status = document(rx=[rx(name, lost=12_345, quality=65535, age_us=65_000_000, late=3)])
    text = show(status, width=width)
    assert max(map(len, text.splitlines())) <= width
    for number in ("123400", "12345", "> 6.5 s", "65.0 s", "55 / 111 / 2222"):
        assert number in text
    assert "…" not in text


def test_state_has_a_colour_on_a_terminal_only() -> None:
    status = document(rx=[rx("left", state="stale")])
    assert "\x1b[1;31mstale" in show(status, color=True)
    assert "\x1b" not in show(status)


def bus_port(name: str = "bus0", **more: Any) -> dict[str, Any]:
    slaves = [
        {"address": 1001, "name": "drive", "state": "OP", "target": "OP", "fault": ""},
        {"address": 1002, "name": "press", "state": None, "target": "OP", "fault": "is lost"},
    ]
    bus = {"is_up": True, "fault": "", "slaves": slaves, "cycles": 12, "lost": 3, "wkc_errors": 0,
           "expected_wkc": 3, "received_wkc": 2, "trip_us": 480, "max_trip_us": 999}  # fmt: skip
    where = "sim:///plants/buses/line.yaml"
    port = {"name": name, "kind": "bus", "net_id": "5.1.1.1.3.1", "interface": where, "link": "up"}
    return port | {"bus": bus | more}


def test_buses() -> None:
    down = bus_port("bus1", is_up=False, fault="no frame comes back\nso far", slaves=[])
    status = document(ports=[bus_port(wkc_errors=4), down])
    status["appliances"][0]["processes"]["segments"] = {"mixer/bus0": {"pid": 7, "restarts": 2}}
    text = show(status)
    assert row_of(text, "mixer/bus0  2") == "mixer/bus0 2 1 OP, 1 no answer 12 3 2 of 3 480 µs"
    assert row_of(text, "mixer/bus1").split()[:3] == ["mixer/bus1", "0", "down"]
    assert "segment mixer/bus0  process 7" in text
    assert "sim://line.yaml" in text
    assert "/plants" not in text
    assert "mixer/bus0: 4 cycles with a wrong working counter" in text
    assert "mixer/bus0 press (1002): is lost" in text
    assert "mixer/bus1: no frame comes back; so far" in text


def test_no_table_of_buses_where_nothing_is_known_of_them() -> None:
    silent = {key: value for key, value in bus_port().items() if key != "bus"}
    assert "Counters" not in show(document(ports=[silent | {"link": "down"}]))


def frame(name: str, **more: Any) -> dict[str, Any]:
    row = {
        "name": name,
        "port": "eap0",
        "destination": "10.0.0.2",
        "address": "10.0.0.2",
        "sent": 90,
        "skipped": 0,
        "frame_state": 0,
        "monitor_interval_ms": None,
        "subscriber": "unknown",
    }
    return row | more


def test_frames_whose_subscriber_is_monitored() -> None:
    frames = [
        frame("to-all", destination="239.1.1.1", address="239.1.1.1"),
        frame("to-panel", monitor_interval_ms=500, subscriber="present"),
        frame("to-oven", monitor_interval_ms=500, subscriber="missing", address="10.0.0.3"),
    ]
    text = show(document(frames=frames))
    assert row_of(text, "Subscriber") == "Frame Goes to Subscriber Frames Skipped"
    assert row_of(text, "to-panel") == "mixer/to-panel 10.0.0.2 present 90 0"
    assert row_of(text, "to-oven") == "mixer/to-oven 10.0.0.2 at 10.0.0.3 missing 90 0"
    assert "to-all" not in text
    assert "Worth a look" not in text


def test_frames_to_a_net_id() -> None:
    frames = [
        frame("known", destination="5.2.2.2.2.1", address="02:00:00:00:00:02"),
        frame("new", destination="5.3.3.3.2.1", address=None, sent=0, skipped=7, frame_state=1),
    ]
    text, _, remarks = show(document(frames=frames)).partition("Worth a look")
    assert row_of(text, "known") == "mixer/known 5.2.2.2.2.1 at 02:00:00:00:00:02 90 0"
    assert row_of(text, "mixer/new") == "mixer/new 5.3.3.3.2.1 at an unknown address 0 7"
    expected = "mixer → new: waits for a frame of 5.3.3.3.2.1, to learn its MAC address"
    assert remarks.strip() == expected


def test_no_table_of_frames_that_have_nothing_more_to_say_than_their_pds() -> None:
    assert "Subscriber" not in show(document(frames=[frame("to-panel")]))
