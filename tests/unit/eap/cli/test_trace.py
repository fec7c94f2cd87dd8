"""``eapctl trace``."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from eap.control.protocol import ErrorCode
from eap.errors import ControlError
from tests.support.controlstub import ControlStub
from tests.unit.eap.cli.test_trace_view import FOUND


def answer(params):
    if params["target"] == "nobody":
        raise ControlError("no station 'nobody' in this plant", code=ErrorCode.UNKNOWN_NAME)
    is_ok = params["target"] != "far"
    return FOUND | {"target": params["target"], "ok": is_ok, "why": "" if is_ok else "x: down"}


@pytest.fixture
def stub(runtime):
    with ExitStack() as stack:
        yield ControlStub("line", ["island-01"], {"trace": answer}, stack)


def test_each_target_has_a_line_of_json(stub):
    result = CliRunner().invoke(main, ["trace", "near", "far", "--json"])
    assert [json.loads(line)["target"] for line in result.stdout.splitlines()] == ["near", "far"]
    assert result.exit_code == 1
    assert CliRunner().invoke(main, ["trace", "near", "--json"]).exit_code == 0


def test_scan_prints_a_table_and_the_sending_station(stub):
    result = CliRunner().invoke(main, ["trace", "far", "--via", "island-01"])
    assert "not reached: x: down" in result.stdout
    assert stub.requests == [("trace", {"target": "far", "via": "island-01"})]


def test_unknown_names_are_refused(stub):
    result = CliRunner().invoke(main, ["trace", "nobody"])
    assert result.exit_code == 1
    assert "no station 'nobody' in this plant" in result.stderr
