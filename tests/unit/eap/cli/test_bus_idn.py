"""``eapctl bus idn``."""

from __future__ import annotations

import json

import click
import pytest
from click.testing import CliRunner

from eap.cli.bus import idn, parse_idn
from eap.cli.group import exit_code_of
from tests.support.loopbus import LoopBus

WHERE = ["--interface", "udp://127.0.4.1"]


@pytest.fixture
def command(monkeypatch):
    LoopBus("drive").replace(monkeypatch)
    return lambda *words: CliRunner().invoke(idn, [*words, *WHERE])


def test_read(command):
    out = command("read", "drive", "S-0-0032").output
    assert out == (
        "S-0-0032 = 2\n  name       Primary operation mode\n  default    2\n"
        "  attribute  unsigned, 4 bytes\n"
    )
    assert json.loads(command("read", "1001", "32", "--json").output)["value"] == 2


def test_write(command):
    assert command("write", "drive", "S-0-0032", "7").output == "S-0-0032 = 7\n"
    row = json.loads(command("write", "drive", "S-0-0032", "8", "--json").output)
    assert row == {"slave": 1001, "drive": 0, "idn": "S-0-0032", "value": 8}


def test_list(command):
    rows = [json.loads(line) for line in command("list", "drive", "--json").output.splitlines()]
    assert {"S-0-0032", "S-0-0017"} <= {row["idn"] for row in rows}
    assert "Primary operation mode" in command("list", "drive").output


def test_refusal_in_words(command):
    result = command("read", "drive", "P-0-4000")
    assert exit_code_of(result.exception) == 1
    assert "no such IDN" in str(result.exception)


def test_numbers_of_idns():
    assert str(parse_idn("0x8001")) == "P-0-0001"
    for text in ("X-1", "70000"):
        with pytest.raises(click.BadParameter, match="not an IDN"):
            parse_idn(text)
