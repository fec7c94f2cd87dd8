"""``eapctl gateway``."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from eap.control.protocol import ErrorCode
from eap.errors import ControlError
from tests.support.controlstub import ControlStub
from tests.unit.eap.cli.test_gateway_view import ROW


@pytest.fixture
def asked(runtime):
    asked = []

    def answer(state):
        def method(params):
            asked.append(params)
            return [ROW | {"state": state}]

        return method

    methods = {
        "gateway_start": answer("running"),
        "gateway_stop": answer("stopped"),
        "gateway_status": answer("running"),
    }
    with ExitStack() as stack:
        ControlStub("line", ["mixer"], methods, stack)
        yield asked


def gateway(*words):
    return CliRunner().invoke(main, ["gateway", *words])


def test_gateway_is_stopped_and_started(asked):
    assert gateway("stop", "mixer/bus0").output == "mixer/bus0: stopped\n"
    assert gateway("start", "mixer").output == "mixer/bus0: running\n"
    assert asked == [{"station": "mixer", "port": "bus0"}, {"station": "mixer", "port": ""}]


def test_status(asked):
    assert json.loads(gateway("status", "mixer", "--json").output) == ROW
    assert "mixer/bus0: running at udp://10.0.0.1:34980" in gateway("status", "mixer").output


def test_status_without_a_station_shows_all_gateways(asked):
    assert json.loads(gateway("status", "--json").output) == ROW
    assert asked == [{"station": "mixer"}]


def test_gateway_status_without_gateways_fails(runtime):
    def refuse(params):
        raise ControlError("station mixer has no gateway", code=ErrorCode.UNKNOWN_NAME)

    with ExitStack() as stack:
        ControlStub("line", ["mixer"], {"gateway_status": refuse}, stack)
        found = gateway("status")
    assert found.exit_code == 1
    assert "no running station has a mailbox gateway" in found.output


@pytest.mark.parametrize("target", ["", "/bus0", "mixer/", "mixer/bus0/1001"])
def test_invalid_target_is_refused(asked, target):
    found = gateway("stop", target)
    assert found.exit_code == 2
    assert "is neither STATION nor STATION/PORT" in found.output
    assert not asked
