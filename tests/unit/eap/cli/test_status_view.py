"""Tables from a literal status document, in the shape that docs/control.md promises."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from eap.cli.status import full_view
from tests.support.statusdocument import (
    NOW_S,
    bus_port,
    document,
    frame,
    rx,
    tx,
    with_findings,
)


def show(status: dict[str, Any], *, width: int = 100, color: bool = False) -> str:
    stream = io.StringIO()
    system = "standard" if color else None
    console = Console(file=stream, width=width, force_terminal=color, color_system=system)
    for part in full_view(with_findings(status), NOW_S):
        console.print(part)
    return stream.getvalue()


def row_of(text: str, word: str) -> str:
    return " ".join(next(line for line in text.splitlines() if word in line).split())


def test_processes_and_stations() -> None:
    text = show(document())
    assert row_of(text, "engine") == "engine 101 4.2 % 35 MB 0"
    assert row_of(text, "services") == "services 102 0"
    assert row_of(text, "mixer") == "mixer OP 10.0 ms eap0 udp://127.0.1.1 5.1.1.1.2.1 up"
    assert "Since the start" not in text


@pytest.mark.parametrize(("compiled", "shown"), [(True, "(compiled)"), (False, "(Python)")])
def test_engine_says_whether_its_cyclic_path_is_compiled(compiled: bool, shown: str) -> None:
    status = document()
    status["processes"]["engine"]["compiled"] = compiled
    assert row_of(show(status), "engine") == f"engine {shown} 101 4.2 % 35 MB 0"


def test_groups_of_stations_with_the_time_of_their_last_one() -> None:
    status = document()
    names = [f"s{n}" for n in range(16)]
    status["processes"]["engine"]["groups"] = [
        {"cycle_us": 1000, "phase_us": 250, "stations": names, "last_us": 412}
    ]
    lines = show(status, width=80).splitlines()
    first = lines.index("Group of cycle  Begins at  Stations  Last station after")
    assert lines[first + 2].split() == ["1.0", "ms", "250", "µs", "16", "412", "µs"]


@pytest.mark.parametrize("state", ["PREOP", "SAFEOP"])
def test_pds_that_the_state_of_the_station_leaves_out_are_off(state: str) -> None:
    shown = show(document(state=state, tx=[tx("speed")], rx=[rx("left")]))
    assert ("→ speed off" in row_of(shown, "→  speed")) == (state == "PREOP")
    assert "← left off" in row_of(shown, "←  left")


def test_process_that_was_restarted_and_one_that_is_being() -> None:
    status = document()
    status["processes"]["engine"]["restarts"] = 2
    status["processes"]["services"]["pid"] = None
    text = show(status)
    assert row_of(text, "engine").endswith("35 MB 2")
    assert row_of(text, "services  ") == "services restarting"


def test_listeners_and_descriptors_are_shown() -> None:
    status = document()
    status["processes"]["engine"]["descriptors"] = {"used": 21, "limit": 1024}
    status["appliances"][0]["listeners"] = [
        {
            "name": "ams-tcp 10.0.0.1:48898", "open": 7, "limit": 128, "refused": 1, "evicted": 2,
            "overdue": 3, "crowded_ago_us": None,
        }
    ]  # fmt: skip
    text = show(status)
    assert row_of(text, "engine") == "engine 101 4.2 % 35 MB 21 of 1024 0"
    assert row_of(text, "ams-tcp") == "ams-tcp 10.0.0.1:48898 7 of 128 1 2 3"


def test_ethernet_of_a_bus_is_shown() -> None:
    slave = {"station": 1001, "name": "drive", "is_connected": True, "ip": "10.0.0.2",
             "received": 7, "sent": 8}  # fmt: skip
    eoe = {"interface": "eoe0", "address": "", "fault": "", "received": 3, "sent": 4, "dropped": 5,
           "slaves": [slave]}  # fmt: skip
    status = document()
    status["stations"][0]["ports"].append(bus_port(eoe=eoe))
    text = show(status)
    assert row_of(text, "eoe0") == "eoe0 open 3 4 5"
    assert row_of(text, "1001 drive") == "1001 drive 10.0.0.2 7 8 0 0 0"


def test_process_that_starts_is_shown_as_such() -> None:
    status = document()
    status["processes"]["engine"]["step"] = "building station mixer"
    assert row_of(show(status), "engine  ") == "engine 101 starting"


def test_received_pds() -> None:
    silent = {"received": 0, "lost": None, "quality": None, "age_us": None, "state": "waiting"}
    silent["jitter_us"] = {"p50": None, "p99": None, "max": None}
    text = show(document(rx=[rx("left"), rx("quiet", **silent)]))
    assert row_of(text, "←  left") == "← left running 123400 0 0 4.2 ms 55 / 111 / 2222"
    assert row_of(text, "←  quiet") == "← quiet waiting 0 unknown"


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


def test_remarks_follow_below_the_tables_and_faults_stand_above() -> None:
    status = document(rx=[rx("left", late=4), rx("right", state="stale")], overruns=1)
    lines = show(status).splitlines()
    assert lines[0] == "line: 1 error (1 station, 2 PDs)"
    assert lines[1].startswith("error  mixer ← right: stale")
    assert lines[-2:] == ["mixer: 1 cycle skipped: overrun", "mixer ← left: 4 late"]


@pytest.mark.parametrize(("width", "left_out"), [(80, "Jitter or response µs"), (100, "")])
def test_tables_keep_their_width_and_break_no_word(width: int, left_out: str) -> None:
    name = "island-01.production-state"
    status = document(rx=[rx(name, lost=12_345, quality=65535, age_us=65_000_000, late=3)])
    text = show(status, width=width)
    assert max(map(len, text.splitlines())) <= width
    for number in (name, "123400", "12345", "> 6.5 s", "65.0 s"):
        assert number in text
    assert ("55 / 111 / 2222" in text) is not bool(left_out)
    assert left_out in text
    assert "…" not in text


def test_state_has_a_colour_on_a_terminal_only() -> None:
    status = document(rx=[rx("left", state="stale")])
    assert "\x1b[1;31mstale" in show(status, color=True)
    assert "\x1b" not in show(status)


def test_buses() -> None:
    down = bus_port("bus1", is_up=False, fault="no frame comes back\nso far", slaves=[])
    status = document(ports=[bus_port(wkc_errors=4), down])
    status["appliances"][0]["processes"]["segments"] = {"mixer/bus0": {"pid": 7, "restarts": 2}}
    text = show(status)
    assert row_of(text, "1 no answer") == "mixer/bus0 2 1 OP, 1 no answer 12 3 2 of 3 480 µs"
    assert row_of(text, "mixer/bus1  ").split()[:3] == ["mixer/bus1", "0", "down"]
    assert row_of(text, "segment mixer/bus0") == "segment mixer/bus0 7 2"
    assert "sim://line.yaml" in text
    assert "/plants" not in text


def test_no_table_of_buses_where_nothing_is_known_of_them() -> None:
    silent = {key: value for key, value in bus_port().items() if key != "bus"}
    assert "Counters" not in show(document(ports=[silent | {"link": "down"}]))


def test_frames_whose_subscriber_is_monitored() -> None:
    frames = [
        frame("to-all", destination="239.1.1.1", address="239.1.1.1"),
        frame("to-panel", monitor_interval_ms=500, subscriber="present"),
        frame("to-oven", monitor_interval_ms=500, subscriber="missing", address="10.0.0.3"),
    ]
    text = show(document(frames=frames))
    assert row_of(text, "Subscriber") == "Frame Destination Subscriber Frames Skipped"
    assert row_of(text, "to-panel") == "mixer/to-panel 10.0.0.2 present 90 0"
    assert row_of(text, "to-oven") == "mixer/to-oven 10.0.0.2 at 10.0.0.3 missing 90 0"
    assert "to-all" not in text
    assert "Since the start" not in text


def test_frames_to_a_net_id() -> None:
    frames = [
        frame("known", destination="5.2.2.2.2.1", address="02:00:00:00:00:02"),
        frame("new", destination="5.3.3.3.2.1", address=None, sent=0, skipped=7, frame_state=1),
    ]
    text = show(document(frames=frames))
    assert row_of(text, "mixer/known") == "mixer/known 5.2.2.2.2.1 at 02:00:00:00:00:02 90 0"
    assert row_of(text, "mixer/new") == "mixer/new 5.3.3.3.2.1 at an unknown address 0 7"


def test_frames_without_more_than_their_pds_have_no_table() -> None:
    assert "Subscriber" not in show(document(frames=[frame("to-panel")]))


def test_bridges_and_their_controllers_are_shown() -> None:
    status = document()
    bridge = {"peer": "s7://127.0.0.1:102", "is_up": True, "reason": "", "since": 0.0,
              "clients": 2, "sent": 90, "received": 7, "refused": 1, "dropped": 0}  # fmt: skip
    press = {"name": "press", "url": "s7://10.0.0.9:102", "is_up": False, "reason": "no route",
             "writes": 5, "values": 12, "failed": 3}  # fmt: skip
    status["processes"]["s7"] = {"pid": 103, "bridge": bridge | {"peers": [press]}}
    text = show(status)
    assert row_of(text, "s7  ") == "s7 103"
    assert row_of(text, "127.0.0.1:102") == "s7 s7://127.0.0.1:102 up 2 90 7 1"
    assert row_of(text, "s7 press") == "s7 press s7://10.0.0.9:102 down 5 3 of 12"
