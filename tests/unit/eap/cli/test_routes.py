"""``eapctl routes`` but for its live view."""

from __future__ import annotations

import json
import sys
from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from tests.support.controlstub import ControlStub
from tests.support.fakeroutes import CLIENT, ISLAND, PRESS, FakeRoutes


@pytest.fixture
def fake():
    return FakeRoutes()


@pytest.fixture
def stub(fake, runtime):
    with ExitStack() as stack:
        yield ControlStub("line", list(fake.stations), fake.table(), stack)


@pytest.fixture
def command(stub):
    return lambda *words: CliRunner().invoke(main, ["routes", *words])


def test_list(command, stub):
    output = command("list").output
    row = next(line.split() for line in output.splitlines() if "island-02 " in line)
    assert row == ["island-01", "island-02", "127.0.1.2.*.*", "udp:eap0", "127.0.1.2:34980", "up",
                   "840", "µs", "12", "0"]  # fmt: skip
    assert "Warnings" in output
    assert "press (192.168.1.5:48898 by ams-tcp) is down: connection refused" in output
    assert "127.0.0.1:40112#3" in output
    assert output == command().output  # no terminal here
    assert stub.requests[0] == ("routes_list", {"station": "", "match": "", "requests": 0})


def test_list_of_one_station_that_matches(command):
    (found,) = json.loads(command("list", "island-01", "--match", "press", "--json").output)[
        "stations"
    ]
    assert [row["name"] for row in found["routes"]] == ["press"]
    assert found["net_id"] == "127.0.1.1.1.1"
    assert len(found["requests"]) == 2
    assert "none" in command("list", "island-02").output


def test_many_routes_come_in_pages(command, fake):
    fake.page = 1
    (found,) = json.loads(command("list", "island-01", "--json").output)["stations"]
    assert [row["name"] for row in found["routes"]] == ["island-02", "press"]


def test_list_without_such_a_station(command):
    result = command("list", "island-03")
    assert result.exit_code == 1
    assert "did you mean island-02" in result.stderr


def test_plant_option_before_a_command_is_refused(command):
    assert command("--plant", "line", "list").exit_code == 2
    assert command("--plant", "line").exit_code == 0


def test_add(command, stub):
    result = command("add", "island-01", "plc", "6.1.2.3.1.1", "--via", "ams-tcp:10.0.0.6",
                     "--octets", "6", "--unidirectional", "--timeout", "900", "--no-probe",
                     "--virtual", "9.1.2.3.1.1", "--port", "eap0")  # fmt: skip
    assert (result.exit_code, result.output) == (
        0, "island-01: added plc (6.1.2.3.1.1, 10.0.0.6 by ams-tcp)\n"
    )  # fmt: skip
    assert stub.requests[-1] == (
        "routes_add",
        {
            "station": "island-01", "name": "plc", "net_id": "6.1.2.3.1.1", "port": "eap0",
            "via": "ams-tcp:10.0.0.6", "octets": 6, "virtual": "9.1.2.3.1.1",
            "unidirectional": True, "timeout_ms": 900, "probed": False,
        },
    )  # fmt: skip


def test_add_prints_warnings_and_refusals(command):
    result = command("add", "island-01", "shadow", "6.1.2.3.1.1", "--via", "ams-tcp:10.0.0.6")
    assert result.stderr == "island-01: route shadow is never taken\n"
    answer = command("add", "island-01", "x", "6.1.2.3.1.2", "--via", "udp:1.2.3.4", "--json")
    assert json.loads(answer.output)["route"]["name"] == "x"
    result = command("add", "island-01", "x", "--via", "nowhere")
    assert (result.exit_code, result.stderr) == (1, "via 'nowhere' is no port of the plant\n")


def test_remove(command, fake):
    assert command("remove", "island-01", "press").output == (
        "island-01: removed press (5.1.2.3.1.1, 192.168.1.5:48898)\n"
    )
    assert fake.stations["island-01"].routes == [ISLAND]
    result = command("remove", "island-01", "island-02")
    assert (result.exit_code, result.stderr) == (1, "route island-02 follows from the plant file\n")
    fake.set_routes("island-01", PRESS)
    answer = json.loads(command("remove", "island-01", "press", "--json").output)
    assert answer["route"]["net_id"] == "5.1.2.3.1.1"


def test_test_of_one_target(command):
    result = command("test", "island-01", "island-02")
    assert result.exit_code == 0
    assert "840 µs answers: RUN" in " ".join(result.output.split())
    result = command("test", "island-01", "press", "--json")
    assert result.exit_code == 1
    assert json.loads(result.output) == {
        "station": "island-01", "target": "5.1.2.3.1.1:10000", "name": "press", "ok": False,
        "rtt_us": None, "state": "", "error": 27, "text": "down: connection refused",
        "hint": "see whether it is switched on",
    }  # fmt: skip


def test_test_of_everything_client_that_does_not_listen_is_no_failure(command, fake):
    fake.set_routes("island-01", ISLAND, CLIENT)
    result = command("test")
    assert result.exit_code == 0
    assert "not listening: connection refused" in result.output
    assert command("test", "island-01", "laptop").exit_code == 1
    output = command("list").output
    assert "client" in output
    assert "laptop (" not in output, "there is nothing to look at"


def test_test_of_everything(command):
    result = command("test")
    assert result.exit_code == 1
    assert "see whether it is switched on" in result.output
    assert "island-02 127.0.1.2.1.1:10000" in " ".join(result.output.split())


@pytest.fixture
def terminal(monkeypatch):
    monkeypatch.setattr("eap.cli.routes.is_terminal", lambda: True)


def test_terminal_gets_the_live_view(command, terminal, monkeypatch):
    shown = []
    monkeypatch.setattr("eap.cli.top.run_app", lambda plant, **more: shown.append((plant, more)))
    assert command("--plant", "line").exit_code == 0
    options = {"tab": "routes", "may_write": True, "instead": "'eapctl routes list'"}
    assert shown == [("line", options)]


def test_routes_without_textual_names_the_extra(command, terminal, monkeypatch):
    ours = ("eap.cli.routes_tui", "eap.cli.top_tui")
    for name in [name for name in sys.modules if name.startswith(ours)]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "textual", None)
    result = command()
    assert result.exit_code == 2
    assert "pip install 'eap-appliance[tui]'" in result.stderr
    assert "eapctl routes list" in result.stderr
