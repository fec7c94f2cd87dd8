"""The disk of the audit is full: nothing is half written, and what is not recorded is known."""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from shutil import copy
from typing import Any

import pytest

from eap.errors import ControlError
from tests.support import aoe
from tests.support.amsclient import AmsClient
from tests.support.appliance import EAPCTL, Appliance, Plants, wait_until
from tests.support.gatewaywire import COE, wire

pytestmark = [pytest.mark.net, pytest.mark.root]

STATION, BUS, DRIVE = "127.9.98.1", "127.9.98.1.3.1", 1001
VALUE = 0x6065_0000
PLANT = f"""\
plant: disk
ACCESS
stations:
  - name: press
    net_id: 127.9.98.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{STATION}", net_id: 127.9.98.1.2.1}}
      - {{name: bus0, kind: bus, interface: "sim://drive.yaml", net_id: {BUS}}}
"""
BUSES = Path(__file__).parents[2] / "config" / "buses"


@pytest.fixture
def disk(farm: Plants, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = farm.folder / "state"
    folder.mkdir()
    options = "size=64k,mode=0700"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=True)
    monkeypatch.setenv("EAP_STATE_DIR", str(folder))
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def start(farm: Plants, access: str) -> Appliance:
    copy(BUSES / "drive.yaml", farm.folder / "drive.yaml")
    appliance = farm.run(farm.write(PLANT.replace("ACCESS", access)))
    with AmsClient(STATION, socket.socket()) as client:
        wait_until(lambda: is_up(client))
    return appliance


def is_up(client: AmsClient) -> bool:
    """Say whether the drive answers, which it does once its bus is up."""
    error, data = client.ask(BUS, aoe.READ, aoe.read_body(VALUE, 4), port=DRIVE)
    return not error and not any(data[:4])


def fill(disk: Path) -> Path:
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as file:
        try:
            while file.write(b"." * 100):
                pass
        except OSError:
            return filler
    raise AssertionError("the disk is never full")


def write(client: AmsClient, value: int) -> int:
    """Return the error or the result of a write to the drive by ADS."""
    body = aoe.write_body(VALUE, struct.pack("<I", value))
    error, data = client.ask(BUS, aoe.WRITE, body, port=DRIVE)
    return error or int.from_bytes(data, "little")


def read(client: AmsClient) -> int:
    _, data = client.ask(BUS, aoe.READ, aoe.read_body(VALUE, 4), port=DRIVE)
    return int.from_bytes(data[8:], "little")


def audit_of(appliance: Appliance) -> dict[str, Any]:
    found: dict[str, Any] = appliance.status()["audit"]
    return found


def lines(disk: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (disk / "disk" / "audit.jsonl").read_text().splitlines()]


def test_changes_on_a_full_disk_are_made_counted_and_reported(farm: Plants, disk: Path) -> None:
    appliance = start(farm, "")
    with AmsClient(STATION, socket.socket()) as client:
        assert write(client, 1) == 0
        assert (disk / "disk").stat().st_mode & 0o777 == 0o700
        filler = fill(disk)
        count = 0
        while not audit_of(appliance)["lines"]:  # the file's last page has room for some
            assert write(client, count) == 0
            count += 1
        assert read(client) == count - 1
        assert audit_of(appliance)["error"] == "No space left on device"
        shown = appliance.command("status")
        assert "changes are not recorded" in " ".join(shown.split())
        written = len(lines(disk))
        filler.unlink()
        wait_until(lambda: not audit_of(appliance)["error"])
        told = lines(disk)[written]
        assert (told["lost"], told["error"]) == (1, "No space left on device")
        assert write(client, 7) == 0
    log = appliance.stop()[2]
    assert "changes are not recorded: No space left on device" in log


def test_changes_on_a_full_disk_are_refused_where_the_audit_is_required(
    farm: Plants, disk: Path
) -> None:
    appliance = start(farm, "access: {audit: required}")
    download = bytes.fromhex("0020 23 6560 00 d2040000")
    with AmsClient(STATION, socket.socket()) as client, wire(STATION) as gateway:
        assert write(client, 4711) == 0
        assert [line.get("begins", False) for line in lines(disk)] == [True, False]
        filler = fill(disk)
        value, result = 1, 0
        while not result:  # the file's last page has room for some
            result = write(client, value)
            value += 1
        assert result == 0x723
        before = read(client)
        assert before != value - 1
        assert gateway.talk(COE, DRIVE, download)[1][2] == 0x80
        # The lines of this request are shorter, and the last page may have room for some.
        with pytest.raises(ControlError):
            wait_until(
                lambda: appliance.request("request_state", target="press", state="OP") is None
            )
        with pytest.raises(ControlError, match="the audit is required and cannot be written: No"):
            appliance.request("request_state", target="press", state="SAFEOP")
        assert read(client) == before
        assert appliance.station("press")["state"] == "OP"
        assert "changes are refused" in " ".join(appliance.command("status").split())
        filler.unlink()
        assert gateway.talk(COE, DRIVE, download)[1][2] == 0x60
        assert read(client) == 1234
        lines(disk)


MAKES_AN_IMAGE = """\
import pathlib, sys
from eap.net.image_file import create_image
from eap.pd.layout import plan_layout
from eap.pd.spec import StationSpec
create_image(pathlib.Path(sys.argv[1]), plan_layout(StationSpec("a", "1.1.1.1.1.1", 1000, ())))
"""


def test_process_image_on_a_full_disk_is_refused_without_a_crash(disk: Path) -> None:
    fill(disk)
    command = [sys.executable, "-c", MAKES_AN_IMAGE, str(disk / "a.image")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1  # and not SIGBUS
    assert done.stderr.splitlines()[-1].endswith("No space left on device")
    assert [each.name for each in disk.iterdir()] == ["filler"]


def test_appliance_runs_although_its_ready_line_cannot_be_written(farm: Plants) -> None:
    plant = farm.write(PLANT.replace("ACCESS", "").replace("kind: bus", "kind: eap"), "full.yaml")
    plant.write_text("\n".join(plant.read_text().splitlines()[:-1]) + "\n")
    environment = os.environ | {"EAP_RUNTIME_DIR": str(farm.folder / "run")}
    with (
        Path("/dev/full").open("w") as full,
        subprocess.Popen(
            [*EAPCTL, "run", str(plant)],
            env=environment, stdout=full, stderr=subprocess.PIPE, text=True,
        ) as appliance,
    ):  # fmt: skip
        assert appliance.stderr is not None
        lines = (line for line in appliance.stderr if "has been starting" not in line)
        line = next(lines)
        appliance.terminate()
        appliance.communicate(timeout=20)
    assert line == (
        "supervisor: the ready line cannot be written to stdout: No space left on device\n"
    )
    assert appliance.returncode == 0
