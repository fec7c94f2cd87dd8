"""A dictionary as a tree."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from tests.support.fakegateway import FakeGateway

pytestmark = pytest.mark.net


@pytest.fixture(scope="module")
def gateway():
    with FakeGateway() as running:
        yield running


def run(gateway: FakeGateway, *arguments: str) -> str:
    words = ["gw", f"127.0.0.1:{gateway.port}", "od", *arguments]
    return CliRunner().invoke(main, words, catch_exceptions=False).output


def test_the_masters_by_default(gateway) -> None:
    lines = run(gateway).splitlines()
    assert lines[0] == "master"
    assert "├── 0x1008 Device name" in lines
    assert "│   └── 00 Device name: M" in lines
    assert any("Fixed station address: 1001" in line for line in lines)


def test_a_slaves(gateway) -> None:
    assert run(gateway, "drive").splitlines()[0] == "drive"
    rows = [json.loads(line) for line in run(gateway, "1001", "--json").splitlines()]
    assert [row["index"] for row in rows] == [0x1008, 0x2000]
