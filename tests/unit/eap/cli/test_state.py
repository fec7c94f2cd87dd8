"""``eapctl state``."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from tests.support.controlstub import ControlStub

REFUSED = {
    "code": 0x8003,
    "text": "0x1A00:00: PDO maps no variable",
    "index": 0x1A00,
    "subindex": 0,
}


class Device:
    """Refuses SAFEOP."""

    def __init__(self) -> None:
        self.now = {"state": "PREOP", "error": None}

    def request(self, params):
        if params["state"] == "SAFEOP":
            self.now = {"state": "PREOP", "error": REFUSED}
        else:
            self.now = {"state": params["state"], "error": None}
        return self.now


@pytest.fixture
def stub(runtime):
    device = Device()
    methods = {"state": lambda _: device.now, "request_state": device.request}
    with ExitStack() as stack:
        yield ControlStub("line", ["mixer"], methods, stack)


def state(*words):
    return CliRunner().invoke(main, ["state", *words])


def test_state_is_shown(stub):
    assert state("mixer").output == "mixer: PREOP\n"
    assert json.loads(state("mixer/eap0", "--json").output) == {
        "target": "mixer/eap0",
        "state": "PREOP",
        "error": None,
    }
    assert stub.requests[-1] == ("state", {"target": "mixer/eap0"})


def test_state_is_requested(stub):
    result = state("mixer", "op")
    assert (result.exit_code, result.output) == (0, "mixer: OP\n")
    assert stub.requests == [("request_state", {"target": "mixer", "state": "OP"})]


def test_refusal(stub):
    result = state("mixer", "SAFEOP")
    assert result.exit_code == 1
    assert result.stdout == "mixer: PREOP\n"
    reason = "0x1A00:00: PDO maps no variable (0x8003)"
    assert result.stderr == f"mixer: SAFEOP was refused: {reason}\n"
    result = state("mixer")
    assert result.exit_code == 0
    assert result.stderr == f"mixer: the last request was refused: {reason}\n"
    result = state("mixer", "SAFEOP", "--json")
    assert (result.exit_code, result.stderr) == (1, "")
    assert json.loads(result.stdout)["error"] == REFUSED


def test_states_of_slaves_are_no_states_of_stations(stub):
    result = state("mixer", "INIT")
    assert result.exit_code == 2
    assert "INIT cannot be requested: expected PREOP, SAFEOP, OP" in result.stderr
    assert state("mixer", "RUN").exit_code == 2


def test_slaves(bus_appliance):
    assert state("press/bus0/sensor").output == "press/bus0/sensor: OP\n"
    assert state("press/bus0/sensor", "SAFEOP").output == "press/bus0/sensor: SAFEOP\n"
    result = state("press/bus0/sensor", "INIT", "--json")
    assert json.loads(result.output) == {
        "target": "press/bus0/sensor",
        "state": "INIT",
        "error": None,
    }
