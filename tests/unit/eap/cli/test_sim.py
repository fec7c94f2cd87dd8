"""``eapctl sim run`` as a command."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from eap.cli.group import exit_code_of
from eap.cli.sim import run
from eap.segment import process as segment_process

COE = Path(__file__).parents[4] / "config" / "buses" / "coe.yaml"


@pytest.fixture
def runs(monkeypatch):
    """Record the segment that would run, instead of running it."""
    found = []

    def pretend(bus, interface, say, *, second, command_fd):
        found.append((bus.spec.bus, str(interface), second and str(second), command_fd))
        say({"ready": True, "slaves": len(bus.spec.slaves)})

    monkeypatch.setattr(segment_process, "run", pretend)
    return found


def invoke(*words):
    return CliRunner().invoke(run, [*map(str, words)])


def test_ready_line(runs):
    result = invoke(COE, "--interface", "udp://127.0.9.1")
    assert result.output == '{"ready":true,"slaves":3}\n'
    assert runs == [("coe", "udp://127.0.9.1", None, None)]


@pytest.mark.parametrize(
    "words", [(COE,), (COE, "--interface", "nothing"), ("--interface", "udp://127.0.9.1")]
)
def test_usage(runs, words):
    assert invoke(*words).exit_code == 2
    assert runs == []


def test_bus_file_that_is_none(runs, tmp_path):
    path = tmp_path / "bus.yaml"
    path.write_text("bus: x\nslaves: [{name: a}]\n")
    result = invoke(path, "--interface", "udp://127.0.9.1")
    assert exit_code_of(result.exception) == 2
    assert "'a' has no kind" in str(result.exception)
    assert runs == []


RING = "bus: r\nring: true\nslaves: [{name: a, kind: coupler}]\n"


@pytest.mark.parametrize(
    ("text", "second", "code"),
    [
        (RING, "ethernet://b", 0),
        (RING, "udp://127.0.9.2", 2),
        (RING.replace("true", "false"), "ethernet://b", 2),
    ],
)
def test_second_line_of_a_ring(runs, tmp_path, text, second, code):
    path = tmp_path / "bus.yaml"
    path.write_text(text)
    result = invoke(path, "--interface", "ethernet://a", "--second", second)
    assert result.exit_code == code
    assert runs == ([("r", "ethernet://a", "ethernet://b", None)] if code == 0 else [])
