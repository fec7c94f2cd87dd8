"""A tool, three stations and a bus in a row of namespaces: pyads reaches the last slave.

The tool connects to the first station by AMS/TCP; from there on there is type 5 over EtherType
0x88A4, with another cable between each two, and nothing but the routes of the plant file.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from shutil import copy

import pytest

from tests.support.appliance import Appliance, Plants, wait_until
from tests.support.machine import slowness
from tests.support.namespaces import Namespace, row

pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = [pytest.mark.net, pytest.mark.root]

PLANT = """\
plant: row
defaults: {cycle_us: 10000}
stations:
  - name: a
    net_id: 5.1.1.1.1.1
    ports:
      - {name: ip0, kind: eap, interface: "udp://10.88.170.2", net_id: 5.1.1.1.2.1}
      - {name: eap0, kind: eap, interface: "ethernet://east0", net_id: 5.1.1.1.2.2}
    routes:
      - {to: b, via: b/eap0, port: eap0}
      - {to: c, via: b/eap0, port: eap0}
    access: [{allow: [all], from: [10.88.170.1]}]
  - name: b
    net_id: 5.1.1.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "ethernet://west0", net_id: 5.1.1.2.2.1}
      - {name: eap1, kind: eap, interface: "ethernet://east0", net_id: 5.1.1.2.2.2}
    routes: [{to: c, via: c/eap0, port: eap1}]
    access: [{allow: [all], net_ids: [10.88.170.1], transports: ["ethernet:eap0"]}]
  - name: c
    net_id: 5.1.1.3.1.1
    ports:
      - {name: eap0, kind: eap, interface: "ethernet://west0", net_id: 5.1.1.3.2.1}
      - {name: bus0, kind: bus, interface: "sim://drive.yaml", net_id: 5.1.1.3.3.1}
    access: [{allow: [all], net_ids: [10.88.170.1], transports: [ethernet]}]
"""
BUSES = Path(__file__).parents[2] / "config" / "buses"
BEGIN = """
import ctypes, hashlib, json, sys, time
import pyads
from pyads import PLCTYPE_STRING as STRING, PLCTYPE_UDINT as UDINT, PLCTYPE_UINT as UINT
def connect(net_id, port):
    connection = pyads.Connection(net_id, port, "10.88.170.2")
    connection.open()
    return connection
def patiently(ask, *what):
    while True:
        try:
            return ask(*what)
        except pyads.ADSError as refusal:
            if refusal.err_code != 0x708:
                raise
"""
DICTIONARY = """
eap = connect("5.1.1.3.2.1", 0xFFFF)
own = eap.read(0xF302, 0xF9200001, ctypes.c_uint8 * 6)
print(json.dumps({"own": ".".join(map(str, own)), "state": eap.read_state(),
                  "objects": len(eap.read(0xF3FC, 1 << 16, UINT * 4000, check_length=False))}))
"""
SLAVE = """
drive = connect("5.1.1.3.3.1", 1001)
vendor = drive.read(0xF302, 0x10180001, UDINT)
drive.write(0xF302, 0x60400000, 6, UINT)  # which the process data overwrite
drive.write(0xF302, 0x60650000, 1234, UDINT)
mode = drive.read(0xF420, 0x400000 | 32, UDINT)
content = bytes(range(256)) * 400
handle = patiently(drive.read_write, 0xF402, 0, UDINT, "firmware.bin", STRING)
for at in range(0, len(content), 10_000):
    piece = content[at : at + 10_000]
    patiently(drive.write, 0xF405, handle, piece, ctypes.c_ubyte * len(piece))
patiently(drive.write, 0xF403, handle, None, None)
print(json.dumps({"vendor": vendor, "mode": mode,
                  "sha256": hashlib.sha256(content).hexdigest()}))
"""
READY = """
print(json.dumps(connect("5.1.1.3.3.1", 1001).read_state()))
"""
REFUSED = """
drive = connect("5.1.1.3.3.1", 1001)
try:
    drive.write(0xF302, 0x60400000, 6, UINT)
except pyads.ADSError as refusal:
    print(json.dumps(refusal.err_code))
"""


class Row:
    """The row, and the appliances in it: the tests of a file share them."""

    def __init__(self, farm: Plants, namespaces: list[Namespace]) -> None:
        self.tool, *self.places = namespaces
        self._farm = farm
        copy(BUSES / "drive.yaml", farm.folder / "drive.yaml")
        self.appliances: dict[str, Appliance] = {}
        self._texts: dict[str, str] = {}

    def start(self, name: str, text: str = PLANT) -> None:
        """Run one station with this plant file, if it does not."""
        running = self.appliances.get(name)
        if running is not None and running.process.poll() is None:
            if self._texts[name] == text:
                return
            running.stop()
        place = self.places["abc".index(name)]
        plant = self._farm.write(text, f"{name}.yaml")
        self.appliances[name] = self._farm.run(plant, "--station", name, prefix=place.prefix)
        self._texts[name] = text

    def plug(self) -> None:
        """Switch all cables on."""
        for place, ends in zip(self.places, ("west0 east0", "west0 east0", "west0"), strict=True):
            for end in ends.split():
                place.ip("link", "set", end, "up")

    def ask(self, script: str) -> object:
        """Run a script of the tool; return what it prints."""
        words = [*self.tool.prefix, sys.executable, "-c", BEGIN + script]
        done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr[-1000:]
        return json.loads(done.stdout)

    def answer(self, script: str) -> object:
        """Return what a script of the tool prints, or None while it fails."""
        with suppress(AssertionError):
            return self.ask(script)
        return None


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> Iterator[Row]:
    with row(4) as namespaces:
        yield Row(module_farm, namespaces)


@pytest.fixture
def line(shared: Row) -> Row:
    shared.plug()
    return shared


def test_last_station_and_its_slave(line: Row) -> None:
    for name in "cba":
        line.start(name)
    wait_until(lambda: line.answer(READY) == [5, 8])
    found = line.ask(DICTIONARY)
    assert found["own"] == "5.1.1.3.2.1"
    assert found["state"] == [5, 8]
    assert found["objects"] > 40
    there = line.ask(SLAVE)
    c = line.appliances["c"]

    def local(*words: str) -> object:
        return json.loads(c.command("bus", *words, "--json"))["value"]

    assert there["vendor"] == local("sdo", "read", "c/bus0", "1001", "0x1018:1")
    assert local("sdo", "read", "c/bus0", "1001", "0x6065") == 1234
    assert there["mode"] == local("idn", "read", "c/bus0", "1001", "S-0-0032")
    copied = c.runtime.parent / "firmware.bin"
    c.command("bus", "foe", "get", "c/bus0", "1001", "firmware.bin", str(copied))
    assert copied.read_bytes() == bytes(range(256)) * 400


def test_cable_that_is_pulled_is_answered_for_at_once(line: Row) -> None:
    for name in "cba":
        line.start(name)
    wait_until(lambda: line.answer(DICTIONARY))
    line.places[1].ip("link", "set", "east0", "down")
    wait_until(
        lambda: "has no link" in str(line.appliances["b"].request("routes_list", station="b"))
    )
    timed = DICTIONARY.replace("eap = ", "began = time.monotonic()\neap = ").replace(
        "own = ",
        "try:\n    eap.read_state()\nexcept pyads.ADSError as error:\n    "
        "print(json.dumps([error.err_code, time.monotonic() - began]))\n    sys.exit()\nown = ",
    )
    code, took_s = line.ask(timed)
    assert code == 0x1B
    assert took_s < 1 * slowness()
    line.places[1].ip("link", "set", "east0", "up")
    wait_until(lambda: line.answer(DICTIONARY))
    wait_until(lambda: "interface east0 has no link" in line.appliances["b"].log())


def test_each_station_on_the_way_judges(line: Row) -> None:
    strict = PLANT.replace(
        "access: [{allow: [all], net_ids: [10.88.170.1], transports: [ethernet]}]", ""
    )
    for name in "cba":
        line.start(name, strict if name == "c" else PLANT)
    wait_until(lambda: line.answer(DICTIONARY))
    assert line.ask(REFUSED) == 0x723
    wait_until(lambda: "no rule allows it" in line.appliances["c"].log())
    assert "WRITE of 5.1.1.3.3.1:1001 for 10.88.170.1.1.1" in line.appliances["c"].log()
