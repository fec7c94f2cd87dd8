"""``eapctl bus STATION/PORT``: the buses of a running plant, by commands and by several at once."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path
from unittest import mock

import pytest

from eap.ops.bus_objects import read_entry
from eap.ops.bus_running import open_running
from eap.runtime.folder import VARIABLE
from tests.support.addresses import own_address
from tests.support.appliance import EAPCTL, plants, run_eapctl, wait_until
from tests.support.machine import slowness
from tests.support.simulator import simulator

pytestmark = pytest.mark.net

BUSES = Path(__file__).parents[2] / "config" / "buses"
STATION = own_address(0)
COE, DRIVE = (f"udp://{own_address(number)}" for number in (1, 2))
OF = {"press/bus0": COE, "press/bus1": DRIVE}
PLANT = f"""
plant: works
defaults: {{cycle_us: 10000}}
stations:
  - name: press
    net_id: 10.9.8.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{STATION}", net_id: 10.9.8.1.2.1}}
      - name: bus0
        kind: bus
        interface: "sim://{BUSES}/coe.yaml"
        net_id: 10.9.8.1.3.1
      - name: bus1
        kind: bus
        interface: "sim://{BUSES}/drive.yaml"
        net_id: 10.9.8.1.4.1
"""


@pytest.fixture(scope="module")
def works():
    """A plant whose slaves are in PREOP, beside segments of the same kind that are too."""
    with plants() as folder:
        appliance = folder.run(folder.write(PLANT))
        with simulator(BUSES / "coe.yaml", COE), simulator(BUSES / "drive.yaml", DRIVE):
            for port, interface in OF.items():
                ask(appliance, "state", port, "PREOP")
                ask(appliance, "state", "PREOP", "--interface", interface)
            yield appliance
        code, out, err = appliance.stop()
        assert (code, out) == (0, ""), err


def eapctl(works, *words):
    return run_eapctl(works.runtime, "bus", *words)


def begin(works, *words):
    """Start a command and do not wait for it."""
    return subprocess.Popen(
        [*EAPCTL, "bus", *words],
        env=os.environ | {VARIABLE: str(works.runtime)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def begin_writing(works, path):
    """Start to write a file to the drive, and wait until it is well under way."""

    def frames_beside_cycles():
        report = works.request("bus_describe", station="press", port="bus1")
        return report["frames_sent"] - report["cycles"]

    before = frames_beside_cycles()
    writing = begin(works, "foe", "put", "press/bus1", "drive", str(path), "firmware.bin")
    wait_until(lambda: frames_beside_cycles() > before + 500)
    assert writing.poll() is None
    return writing


def ask(works, *words):
    """Return the JSON lines that a command prints."""
    done = eapctl(works, *words, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    return [json.loads(line) for line in done.stdout.splitlines()]


def both(works, verbs, port, *words):
    """Return what a command says of a port, and of an interface."""
    found = ask(works, *verbs, port, *words), ask(works, *verbs, *words, "--interface", OF[port])
    for lines in found:
        for line in lines:
            for volatile in ("frames", "seconds", "rate"):
                line.pop(volatile, None)
            if line.get("index") == 0x6000 and line.get("subindex"):
                del line["value"], line["data"]  # inputs go up and down
    return found


def usable(works):
    """True if both protocols of the drive work."""
    (row,) = ask(works, "sdo", "read", "press/bus1", "drive", "0x1018:1")
    assert row["value"] == 0xE5A
    return True


@pytest.fixture
def content(tmp_path):
    """A file that takes a while."""
    path = tmp_path / "content.bin"
    path.write_bytes(os.urandom(200_000))
    return path


@pytest.mark.parametrize(
    ("verbs", "port", "words"),
    [
        (["scan"], "press/bus0", []),
        (["scan"], "press/bus1", []),
        (["state"], "press/bus0", []),
        (["state"], "press/bus0", ["sensor", "SAFEOP"]),
        (["state"], "press/bus0", ["OP"]),
        (["state"], "press/bus0", ["PREOP"]),
        (["state"], "press/bus1", ["drive", "BOOT"]),
        (["state"], "press/bus1", ["PREOP"]),
        (["diag"], "press/bus0", []),
        (["sdo", "read"], "press/bus0", ["sensor", "0x8000:1"]),
        (["sdo", "read"], "press/bus0", ["1003", "0x8000", "--complete"]),
        (["sdo", "write"], "press/bus0", ["sensor", "0x8000:2", "-7"]),
        (["sdo", "list"], "press/bus0", ["sensor"]),
        (["sdo", "dump"], "press/bus0", ["sensor"]),
        (["idn", "read"], "press/bus1", ["drive", "S-0-0032"]),
        (["idn", "write"], "press/bus1", ["drive", "S-0-0032", "7"]),
        (["idn", "list"], "press/bus1", ["drive"]),
        (["sii", "dump"], "press/bus1", ["drive"]),
        (["voe"], "press/bus1", ["drive", "c0ffee", "--vendor", "1"]),
    ],
)
def test_a_port_is_as_good_as_an_interface(works, verbs, port, words):
    asked, own = both(works, verbs, port, *words)
    assert asked == own
    assert asked


def test_files_and_eeproms(works, content, tmp_path):
    asked, own = both(works, ["foe", "put"], "press/bus1", "drive", str(content), "firmware.bin")
    assert asked == own
    back = tmp_path / "back.bin"
    asked, own = both(works, ["foe", "get"], "press/bus1", "drive", "firmware.bin", str(back))
    assert asked == own
    assert back.read_bytes() == content.read_bytes()
    image = tmp_path / "image.bin"
    ask(works, "sii", "dump", "press/bus0", "buttons", str(image))
    asked, own = both(works, ["sii", "write"], "press/bus0", "buttons", str(image))
    assert asked == own


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["scan", "press/bus3"], "its bus ports are bus0, bus1"),
        (["scan", "prss/bus0"], "did you mean press?"),
        (["sdo", "read", "press/bus0", "sensor", "0x8000:7"], "subindex does not exist"),
        (["foe", "get", "press/bus1", "drive", "nothing.bin"], "not found"),
        (["voe", "press/bus0", "sensor", "00", "--vendor", "1"], "mailbox error"),
    ],
)
def test_bus_command_that_is_refused_ends_with_one_line(works, words, reason):
    done = eapctl(works, *words)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("\n") == 1
    assert reason in done.stderr


def test_a_file_and_objects_of_one_slave_at_once(works, content):
    writing = begin(works, "foe", "put", "press/bus1", "drive", str(content), "firmware.bin")
    reads = 0
    with (
        mock.patch.dict(os.environ, {VARIABLE: str(works.runtime)}),
        open_running("press", "bus1") as bus,
    ):
        while writing.poll() is None:
            found = read_entry(bus, "drive", 0x1018, 1, kind=None, complete=False)
            assert found.value == 0xE5A
            reads += 1
    out, err = writing.communicate()
    assert (writing.returncode, err) == (0, "")
    assert "200000 bytes" in out
    assert reads > 10


def test_two_files_at_once_come_one_after_the_other(works, content, tmp_path):
    second = tmp_path / "second.bin"
    second.write_bytes(content.read_bytes()[::-1])
    writing = [
        begin(works, "foe", "put", "press/bus1", "drive", str(path), "firmware.bin")
        for path in (content, second)
    ]
    assert [each.communicate()[1] for each in writing] == ["", ""]
    assert [each.returncode for each in writing] == [0, 0]
    back = tmp_path / "back.bin"
    ask(works, "foe", "get", "press/bus1", "drive", "firmware.bin", str(back))
    assert back.read_bytes() in {content.read_bytes(), second.read_bytes()}


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_client_that_ends_in_the_middle_of_a_file(works, content, tmp_path, number):
    ask(works, "foe", "put", "press/bus1", "drive", str(content), "firmware.bin")
    large = tmp_path / "large.bin"
    large.write_bytes(bytes(4_000_000))
    writing = begin_writing(works, large)
    writing.send_signal(number)
    _, err = writing.communicate(timeout=20)
    assert writing.returncode == (1 if number == signal.SIGINT else -number)
    assert "Traceback" not in err
    begun = time.monotonic()
    assert usable(works)
    back = tmp_path / "back.bin"
    ask(works, "foe", "get", "press/bus1", "drive", "firmware.bin", str(back))
    assert back.read_bytes() == content.read_bytes()
    assert time.monotonic() - begun < 5 * slowness()


def test_status_tells_of_buses_and_of_faults(works):
    ports = {port["name"]: port for port in works.station("press")["ports"]}
    assert [ports[name]["link"] for name in ("bus0", "bus1")] == ["up", "up"]
    bus = ports["bus0"]["bus"]
    assert (bus["is_up"], bus["fault"]) == (True, "")
    assert [(each["address"], each["name"], each["state"]) for each in bus["slaves"]] == [
        (1001, "coupler", "PREOP"),
        (1002, "buttons", "PREOP"),
        (1003, "sensor", "PREOP"),
    ]
    works.command("sim", "fault", "press/bus0", "power", "slave=sensor")
    try:

        def gone():
            slaves = works.station("press")["ports"][1]["bus"]["slaves"]
            return slaves[2]["state"] is None

        wait_until(gone)
        assert "no answer" in works.command("status")
    finally:
        works.command("sim", "fault", "press/bus0", "power", "slave=sensor", "--end")
    wait_until(lambda: not gone())


def test_value_of_an_input_by_command(works):
    works.command("sim", "set", "press/bus0", "sensor", "0x6000:1", "-321")
    (row,) = ask(works, "sdo", "read", "press/bus0", "sensor", "0x6000:1")
    assert row["value"] == -321
    works.command("sim", "set", "press/bus0", "sensor", "0x6000:1", "--release")


def test_engine_that_hangs_is_said_to(works):
    pid = works.pid("engine")
    os.kill(pid, signal.SIGSTOP)
    try:
        port = works.station("press")["ports"][1]
        assert port["link"] == "down"
        assert "bus" not in port
        done = eapctl(works, "sdo", "read", "press/bus0", "sensor", "0x1018:1")
        assert done.returncode == 1
        assert "the engine does not answer" in done.stderr
    finally:
        os.kill(pid, signal.SIGCONT)
    wait_until(lambda: works.station("press")["ports"][1]["link"] == "up")


def test_restarted_engine_fails_the_requests_in_flight(works, tmp_path):
    large = tmp_path / "large.bin"
    large.write_bytes(bytes(4_000_000))
    writing = begin_writing(works, large)
    os.kill(works.pid("engine"), signal.SIGKILL)
    _, err = writing.communicate(timeout=60)
    assert writing.returncode == 1
    assert "engine" in err
    assert usable(works)  # the bus is waited for


def test_services_that_start_again_are_waited_for(works):
    pid = works.pid("services")
    os.kill(pid, signal.SIGKILL)
    assert usable(works)
    assert works.pid("services") != pid
