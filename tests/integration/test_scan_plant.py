"""A plant of 14 through one connection: scanned whole, traced, and with most of it gone."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from shutil import copy
from typing import Any, NamedTuple

import pytest

from tests.support.appliance import Appliance, Plants, run_eapctl, wait_until

pytestmark = pytest.mark.net

COUNT = 14
BUSES = Path(__file__).parents[2] / "config" / "buses"
SLAVES = ["coupler", "buttons", "sensor"]


def address(number: int) -> str:
    return f"127.9.61.{number}"


def name(number: int) -> str:
    return f"island-{number:02}"


PATIENT = "buttons: {watchdog: {process_data_ms: 0}}"
"""A cycle that a busy machine delays takes no slave out of OP."""


def station(number: int) -> str:
    own = address(number)
    return f"""\
  - name: {name(number)}
    net_id: {own}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{own}", net_id: {own}.2.1}}
      - {{name: bus0, kind: bus, interface: "sim://coe.yaml", net_id: {own}.3.1,
         slaves: {{{PATIENT}}}}}
"""


PLANT = "plant: row\ndefaults: {cycle_us: 50000}\nstations:\n" + "".join(
    map(station, range(1, COUNT + 1))
)


class Row(NamedTuple):
    """The first station in an appliance of its own, and all others in another one."""

    first: Appliance
    others: Appliance

    def eapctl(self, *words: str) -> subprocess.CompletedProcess[str]:
        return run_eapctl(self.first.runtime, *words)

    def scan(self) -> list[dict[str, Any]]:
        stations: list[dict[str, Any]] = json.loads(self.eapctl("scan", "--json").stdout)[
            "stations"
        ]
        return stations

    def is_whole(self) -> bool:
        slaves = [slave for row in self.scan() for port in row["ports"] for slave in port["slaves"]]
        return [slave["state"] for slave in slaves] == ["OP"] * len(SLAVES) * COUNT


@pytest.fixture
def row(farm: Plants) -> Row:
    copy(BUSES / "coe.yaml", farm.folder / "coe.yaml")
    plant = farm.write(PLANT)
    rest = [word for number in range(2, COUNT + 1) for word in ("--station", name(number))]
    others = farm.run(plant, *rest)
    return Row(farm.run(plant, "--station", name(1)), others)


@pytest.mark.timeout(400)  # 14 buses and their slaves, beside whatever else a machine does
def test_one_connection_lists_every_port_and_slave(row: Row) -> None:
    wait_until(row.is_whole, 60)
    found = row.scan()
    assert [(each["name"], each["net_id"]) for each in found] == [
        (name(number), f"{address(number)}.1.1") for number in range(1, COUNT + 1)
    ]
    for number, each in enumerate(found, 1):
        assert each["error"] == ""
        assert [(port["name"], port["kind"], port["net_id"]) for port in each["ports"]] == [
            ("eap0", "eap", f"{address(number)}.2.1"),
            ("bus0", "bus", f"{address(number)}.3.1"),
        ]
        assert each["ports"][0]["interface"] == f"udp://{address(number)}"
        assert each["ports"][1]["slaves"] == [
            {"address": 1000 + place, "name": slave, "state": "OP"}
            for place, slave in enumerate(SLAVES, 1)
        ]
    check_lines_to_paste(row)
    check_trace(row)
    check_devices(row)
    row.others.close()
    check_what_is_left(row)


def check_lines_to_paste(row: Row) -> None:
    pytest.importorskip("pyads", reason="needs pyads: pip install pyads")
    _, _, *lines = row.eapctl("scan").stdout.splitlines()
    assert len(lines) == COUNT * (3 + len(SLAVES))
    (line,) = (each for each in lines if each.startswith(f"{name(COUNT)}/bus0/1002 "))
    (client,) = re.findall(r"pyads\.Connection\(.*\)", line)
    script = f"import pyads\nslave = {client}\nslave.open()\nprint(slave.read_state())"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "(5, 8)\n"


def check_trace(row: Row) -> None:
    done = row.eapctl("trace", f"{name(9)}/bus0/sensor", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert [hop["station"] for hop in found["hops"]] == [name(1), name(9)]
    assert found["answer"]["error"] == 0
    assert found["hops"][0]["route"] == name(9)


def check_devices(row: Row) -> None:
    """Objects and states of stations that run elsewhere, by name and by address."""
    slave = f"{name(9)}/bus0/sensor"

    def ask(*words: str) -> Any:
        done = row.eapctl(*words, "--json")
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    assert ask("od", "write", slave, "0x8000:1", "77")["value"] == 77
    assert ask("od", "read", f"{address(9)}.3.1:1003", "0x8000:1")["value"] == 77
    assert ask("od", "read", name(9), "0xF920:1")["value"] == f"{address(9)}.2.1"
    assert ask("state", slave)["state"] == "OP"
    for wanted in ("SAFEOP", "OP"):
        assert ask("state", slave, wanted)["state"] == wanted
    assert ask("state", f"{name(9)}/bus0")["state"] == "OP"
    assert ask("state", name(9), "PREOP")["state"] == "PREOP"
    assert ask("state", name(9), "OP") == {"target": name(9), "state": "OP", "error": None}
    assert "0x8000" in row.eapctl("od", "list", slave).stdout
    refused = row.eapctl("od", "read", slave, "0x9999")
    assert refused.returncode == 1
    assert "0x9999:00: there is no such object or entry (error 0x70c)" in refused.stderr


def check_what_is_left(row: Row) -> None:
    """The appliance with all others is gone: what the plant file says of them is still told."""
    wait_until(lambda: row.scan()[8]["error"], 30)
    done = row.eapctl("scan", "--json")
    assert done.returncode == 0
    here, *gone = json.loads(done.stdout)["stations"]
    assert here["error"] == ""
    assert all(each["error"] for each in gone)
    assert [slave["state"] for slave in gone[0]["ports"][1]["slaves"]] == [None] * len(SLAVES)
    assert (
        f"{name(9)}: {name(1)}: {name(9)} ({address(9)}:34980 by udp:eap0) is down" in done.stderr
    )
    trace = row.eapctl("trace", f"{name(9)}/bus0/sensor")
    assert trace.returncode == 1
    assert f"not reached: {name(1)}: {name(9)} (" in trace.stdout
