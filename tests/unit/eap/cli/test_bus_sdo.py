"""``eapctl bus sdo``."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from eap.cli.bus import sdo
from eap.cli.group import exit_code_of
from tests.support.loopbus import LoopBus

WHERE = ["--interface", "udp://127.0.4.1"]


@pytest.fixture
def command(monkeypatch):
    LoopBus("coe").replace(monkeypatch)
    return lambda *words: CliRunner().invoke(sdo, [*words, *WHERE])


def test_read(command):
    assert command("read", "1003", "0x1018:1").output == "0x1018:01 = UDINT 3674 (0x00000E5A)\n"
    row = json.loads(command("read", "sensor", "1018:1", "--type", "UINT", "--json").output)
    assert (row["type"], row["value"], row["data"]) == ("UINT", None, "5a0e0000")


def test_write(command):
    assert command("write", "sensor", "0x8000:2", "-5").output == "0x8000:02 = -5\n"
    row = json.loads(command("write", "sensor", "0x8000:1", "6", "--json").output)
    assert row["data"] == "06000000"
    assert command("read", "sensor", "0x8000", "--complete").output == (
        "0x8000:00 = [02 00 06 00 00 00 fb ff] (8 bytes)\n"
    )


def test_abort_in_words(command):
    result = command("read", "sensor", "0x1018:9")
    assert str(result.exception) == "0x1018:09: subindex does not exist (0x06090011)"
    assert exit_code_of(result.exception) == 1


def test_value_that_is_none(command):
    result = command("write", "sensor", "0x8000:1", "many")
    assert exit_code_of(result.exception) == 2


@pytest.mark.parametrize("words", [("read", "sensor", "x"), ("read", "sensor"), ("fly",)])
def test_usage(command, words):
    assert command(*words).exit_code == 2


def test_list(command):
    rows = [json.loads(line) for line in command("list", "sensor", "--json").output.splitlines()]
    assert {row["index"] for row in rows} >= {0x1018, 0x8000, 0x8001}
    assert "0x8001  Calibration" in command("list", "sensor").output


def test_dump(command):
    rows = [json.loads(line) for line in command("dump", "sensor", "--json").output.splitlines()]
    values = {(row["index"], row["subindex"]): row["value"] for row in rows}
    assert values[0x8000, 1] == 50
    assert "Settings: Filter" in command("dump", "sensor").output
