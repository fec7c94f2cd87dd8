"""``eapctl routes scan``."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from tests.support.controlstub import ControlStub

FOUND = {
    "station": "left",
    "name": "cx",
    "net_id": "5.1.2.3.1.1",
    "address": "10.0.0.5",
    "version": "3.1.4024",
    "route": "cx",
    "is_learned": True,
}


@pytest.fixture
def stub(runtime):
    with ExitStack() as stack:
        yield ControlStub("line", ["left"], {"routes_scan": lambda params: [FOUND]}, stack)


def run(*words):
    return CliRunner().invoke(main, ["routes", "scan", *words])


def test_routes_scan_prints_a_row_per_router(stub):
    result = run()
    assert result.exit_code == 0
    assert "5.1.2.3.1.1" in result.output
    assert "cx (auto-discovered)" in result.output
    assert stub.requests == [("routes_scan", {"station": "", "address": "", "wait_ms": 1000})]


def test_one_object_a_router(stub):
    result = run("left", "--address", "10.0.0.255", "--wait", "50", "--json")
    assert [json.loads(line) for line in result.output.splitlines()] == [FOUND]
    assert stub.requests[-1][1] == {"station": "left", "address": "10.0.0.255", "wait_ms": 50}
