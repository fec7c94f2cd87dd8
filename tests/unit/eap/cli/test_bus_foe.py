"""``eapctl bus foe``."""

from __future__ import annotations

import json
from hashlib import sha256

import pytest
from click.testing import CliRunner
from rich.console import Console

from eap.cli.bus import foe
from eap.cli.group import exit_code_of
from tests.support.loopbus import LoopBus

WHERE = ["--interface", "udp://127.0.4.1"]
CONTENT = bytes(range(256)) * 100


@pytest.fixture
def command(monkeypatch, tmp_path):
    LoopBus("drive").replace(monkeypatch)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "new.bin").write_bytes(CONTENT)
    return lambda *words: CliRunner().invoke(foe, [*words, *WHERE])


def test_there_and_back(command, tmp_path):
    result = command("put", "drive", "new.bin", "firmware.bin")
    assert result.output.startswith("new.bin → firmware.bin: 25600 bytes in ")
    assert result.output.endswith(f"sha256 {sha256(CONTENT).hexdigest()}\n")
    row = json.loads(command("get", "drive", "firmware.bin", "--json").output)
    assert (row["file"], row["octets"]) == ("firmware.bin", 25600)
    assert (tmp_path / "firmware.bin").read_bytes() == CONTENT


def test_bar_on_a_terminal(command, monkeypatch):
    monkeypatch.setattr(Console, "is_terminal", property(lambda self: True))
    result = command("put", "drive", "new.bin", "firmware.bin")
    assert "25.6/25.6 kB" in result.stderr
    assert "new.bin → firmware.bin" in result.stdout
    assert command("put", "drive", "new.bin", "firmware.bin", "--json").stderr == ""


def test_file_that_is_not_there(command):
    assert exit_code_of(command("get", "drive", "nothing", "x").exception) == 1
    assert exit_code_of(command("put", "drive", "nothing").exception) == 2


def test_stdin_and_stdout(monkeypatch, tmp_path):
    LoopBus("drive").replace(monkeypatch)
    monkeypatch.chdir(tmp_path)
    words = ["put", "drive", "-", "firmware.bin", *WHERE]
    assert CliRunner().invoke(foe, words, input=CONTENT).exit_code == 0
    result = CliRunner().invoke(foe, ["get", "drive", "firmware.bin", "-", *WHERE])
    assert result.stdout_bytes == CONTENT
    assert f"sha256 {sha256(CONTENT).hexdigest()}" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_foe_refuses_stdin_without_a_name_and_json_with_stdout(command):
    nameless = command("put", "drive", "-")
    assert (nameless.exit_code, "has no name: give NAME" in nameless.stderr) == (2, True)
    both = command("get", "drive", "firmware.bin", "-", "--json")
    assert (both.exit_code, "and --json go to stdout" in both.stderr) == (2, True)
