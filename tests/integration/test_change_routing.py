"""Routes and access rules of running stations become what a plant file says, and back."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from tests.integration.test_ams_listeners import AmsClient, is_free
from tests.support import aoe
from tests.support.appliance import Appliance, Plants, run_eapctl, wait_until

pytestmark = pytest.mark.net

LEFT, RIGHT = "127.9.72.1", "127.9.72.2"
PLANT = """\
plant: ruled
stations:
  - name: left
    net_id: 127.9.72.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.72.1", net_id: 127.9.72.1.2.1}
  - name: right
    net_id: 127.9.72.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.72.2", net_id: 127.9.72.2.2.1}
"""
RULE = "2.1}\n    access: [{name: nobody, deny: [all], transports: [ams-tcp]}]\n  - name: right"
DENIED = 0x723


@pytest.fixture
def file(farm: Plants) -> Path:
    wait_until(lambda: all(map(is_free, (LEFT, RIGHT))))
    return farm.write(PLANT)


def error_of(target: str) -> int:
    with AmsClient(LEFT) as client:
        return client.ask(target, aoe.READ_STATE, b"")[0]


def both() -> list[int]:
    """Return what a client of the left station is told, there and behind it."""
    return [error_of(f"{LEFT}.2.1"), error_of(f"{RIGHT}.2.1")]


def change(appliance: Appliance, *words: str) -> str:
    done = run_eapctl(appliance.runtime, *words)
    return done.stdout + done.stderr


def test_a_rule_comes_goes_and_outlives_services_and_a_new_start(farm, file):
    appliance = farm.run(file)
    wait_until(lambda: both() == [0, 0])
    file.write_text(PLANT.replace("2.1}\n  - name: right", RULE))
    words = str(file)
    assert "  * access rule nobody: added" in change(appliance, "plan", words)
    assert "left (access rule nobody: added): ok" in change(appliance, "apply", words)
    assert both() == [DENIED, DENIED]
    assert "no differences" in change(appliance, "plan", words)
    os.kill(appliance.pid("services"), signal.SIGKILL)
    wait_until(lambda: both() == [DENIED, DENIED])
    assert "left (access rule nobody: removed): ok" in change(appliance, "rollback", words)
    assert both() == [0, 0]
    change(appliance, "apply", words)
    appliance.stop()
    wait_until(lambda: all(map(is_free, (LEFT, RIGHT))))
    again = farm.run(file)
    assert both() == [DENIED, DENIED]
    assert "no differences" in change(again, "plan", words)
