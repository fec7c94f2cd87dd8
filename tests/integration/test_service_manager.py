"""An appliance under a service manager: readiness, and a watchdog that is not served in vain."""

from __future__ import annotations

import os
import signal
import socket

import pytest

from eap.config.new_plant import Shape, plant_text
from tests.support.appliance import wait_until

pytestmark = pytest.mark.net
SILENT = "no sign of life for the watchdog"


@pytest.fixture
def manager(tmp_path, monkeypatch):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as opened:
        opened.bind(str(tmp_path / "notify"))
        opened.settimeout(60)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "900000")
        yield opened


def read_until(manager: socket.socket, wanted: str) -> None:
    while wanted not in manager.recv(4096).decode():
        pass


def drain(manager: socket.socket) -> list[str]:
    manager.setblocking(False)
    found = []
    try:
        while True:
            found.append(manager.recv(4096).decode())
    except BlockingIOError:
        manager.settimeout(60)
        return found


def test_watchdog_of_an_appliance_is_served_while_its_engine_runs_cycles(farm, manager):
    plant = farm.write(plant_text("kept", 2, Shape.RING, address="127.9.97.{n}"))
    appliance = farm.start(plant)
    read_until(manager, "READY=1\nSTATUS=plant kept: station-01, station-02")
    read_until(manager, "WATCHDOG=1")
    engine = appliance.pid("engine")
    before = appliance.log().count(SILENT)
    os.kill(engine, signal.SIGSTOP)
    try:
        wait_until(lambda: appliance.log().count(SILENT) > before)
        drain(manager)
        assert drain(manager) == []
    finally:
        os.kill(engine, signal.SIGCONT)
    read_until(manager, "WATCHDOG=1")
    os.kill(engine, signal.SIGKILL)
    wait_until(lambda: "engine runs again" in appliance.log())
    drain(manager)
    read_until(manager, "WATCHDOG=1")
    assert appliance.stop()[0] == 0
    assert "STOPPING=1" in drain(manager)
