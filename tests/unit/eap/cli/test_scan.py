"""``eapctl scan``."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from tests.support.controlstub import ControlStub
from tests.unit.eap.cli.test_scan_view import DEAD, STATION, answer


@pytest.fixture
def stub(runtime):
    with ExitStack() as stack:
        yield ControlStub("line", ["island-01"], {"scan": lambda _: answer(STATION, DEAD)}, stack)


def test_json_is_that_of_the_contract(stub):
    result = CliRunner().invoke(main, ["scan", "--json"])
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    assert found["stations"] == [STATION, DEAD]
    assert found["via"] == [{"station": "island-01", "address": "127.0.1.1"}]
    assert result.stderr.splitlines() == ["i2: 7", "i2/bus0: down"]


def test_scan_prints_text_lines_and_the_sending_station(stub):
    result = CliRunner().invoke(main, ["scan", "--via", "island-01"])
    assert 'pyads.Connection("127.0.1.1.3.1", 1001, "127.0.1.1")' in result.stdout
    assert stub.requests == [("scan", {"via": "island-01"})]
    assert CliRunner().invoke(main, ["scan", "--via", "island-09"]).exit_code == 1
