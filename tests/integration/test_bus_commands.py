"""``eapctl bus`` on simulated segments in processes of their own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.addresses import own_address
from tests.support.appliance import run_eapctl, spawn_eapctl
from tests.support.simulator import FAR, NEAR, simulator, veth_pair

pytestmark = pytest.mark.net

BUSES = Path(__file__).parents[2] / "config" / "buses"
COE = f"udp://{own_address(0)}"
DRIVE = f"udp://{own_address(1)}"
NOBODY = f"udp://{own_address(2)}"


def eapctl(*words, interface):
    # A process keeps the network that it asked for interfaces first.
    run = spawn_eapctl if interface == f"ethernet://{NEAR}" else run_eapctl
    return run(Path(), "bus", *words, "--interface", interface)


def ask(*words, interface):
    """Return the JSON lines that a command prints."""
    done = eapctl(*words, "--json", interface=interface)
    assert (done.returncode, done.stderr) == (0, "")
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.fixture(scope="module")
def coe():
    with simulator(BUSES / "coe.yaml", COE) as running:
        yield running


@pytest.fixture(scope="module")
def drive():
    with simulator(BUSES / "drive.yaml", DRIVE):
        yield


def test_bus_scan_lists_slaves(coe):
    (found,) = ask("scan", interface=COE)
    assert [(row["address"], row["name"], row["vendor"]) for row in found["slaves"]] == [
        (1001, "coupler", 0xE5A),
        (1002, "buttons", 0xE5A),
        (1003, "sensor", 0xE5A),
    ]


def test_bus_sdo_reads_what_it_wrote(coe):
    for number in range(3):
        ask("sdo", "write", "sensor", "0x8000:1", str(number), interface=COE)
        (row,) = ask("sdo", "read", "1003", "0x8000:1", interface=COE)
        assert row["value"] == number
    assert len(ask("sdo", "list", "1003", interface=COE)) > 10
    refused = eapctl("sdo", "read", "sensor", "0x8000:7", interface=COE)
    assert (refused.returncode, refused.stdout) == (1, "")
    assert refused.stderr == "0x8000:07: subindex does not exist (0x06090011)\n"


def test_bus_state_brings_all_slaves(coe):
    for state in ("OP", "PREOP", "INIT"):
        (found,) = ask("state", state, interface=COE)
        assert [row["state"] for row in found["slaves"]] == [state] * 3


def test_slave_that_is_cut_off(coe):
    assert coe.fault(kind="cut", slave="sensor")["ok"]
    try:
        (found,) = ask("diag", interface=COE)
        assert len(found["slaves"]) == 2
        gone = eapctl("sdo", "read", "sensor", "0x1018:1", interface=COE)
        assert gone.returncode == 1
        assert "unknown slave 'sensor'" in gone.stderr
    finally:
        coe.fault(kind="cut", slave="sensor", end=True)


def test_bus_foe_returns_the_file_that_it_put(drive, tmp_path):
    there, back = tmp_path / "there.bin", tmp_path / "back.bin"
    there.write_bytes(bytes(range(256)) * 1000)
    for state in ("PREOP", "BOOT"):
        ask("state", "drive", state, interface=DRIVE)
        (put,) = ask("foe", "put", "drive", str(there), "firmware.bin", interface=DRIVE)
        (got,) = ask("foe", "get", "drive", "firmware.bin", str(back), interface=DRIVE)
        assert put["octets"] == got["octets"] == 256_000
        assert put["sha256"] == got["sha256"]
        assert back.read_bytes() == there.read_bytes()


def test_bus_commands_of_other_protocols_answer(drive):
    ask("state", "drive", "PREOP", interface=DRIVE)
    ask("idn", "write", "drive", "S-0-0032", "3", interface=DRIVE)
    (row,) = ask("idn", "read", "drive", "S-0-0032", interface=DRIVE)
    assert row["value"] == 3
    (row,) = ask("voe", "drive", "c0ffee", "--vendor", "1", interface=DRIVE)
    assert row["data"] == "c0ffee"


def test_bus_that_is_not_there():
    done = eapctl("scan", interface=NOBODY)
    assert (done.returncode, done.stdout) == (1, "")
    assert "no frame came back" in done.stderr
    assert eapctl("scan", interface="ethernet://nothere").returncode == 2


@pytest.mark.root
def test_bus_commands_work_by_raw_ethernet(tmp_path):
    with veth_pair(), simulator(BUSES / "drive.yaml", f"ethernet://{FAR}"):
        (found,) = ask("scan", interface=f"ethernet://{NEAR}")
        assert [row["name"] for row in found["slaves"]] == ["drive"]
        (row,) = ask("sdo", "read", "drive", "0x1018:1", interface=f"ethernet://{NEAR}")
        assert row["value"] == 0xE5A
        file = tmp_path / "f.bin"
        file.write_bytes(b"x" * 50_000)
        words = ("foe", "put", "drive", str(file), "firmware.bin")
        (done,) = ask(*words, interface=f"ethernet://{NEAR}")
        assert done["octets"] == 50_000
