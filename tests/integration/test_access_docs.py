"""docs/access.md: its rules load from a plant file and decide as the page says."""

from __future__ import annotations

import re
from pathlib import Path
from shutil import copy

import pytest

from eap.ads.request import Operation, Read, ReadWrite, Write
from eap.ams.access import AccessList
from eap.ams.directory import Directory
from eap.codec.ads import IndexGroup
from eap.ids import Endpoint, NetId
from eap.runtime.plantfile import load_plant

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "access.md").read_text()
(PLANT,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
G = IndexGroup
LAPTOP, SERVER = Endpoint("ams-tcp", "10.0.7.20:1"), Endpoint("ams-tcp", "10.0.0.5:1")
NEIGHBOUR = Endpoint("udp:eap0", "10.0.0.2:34980")
READ, POSITION = Read(G.SDO, 0x1018_0001, 4), Write(G.SDO, 0x607A_0000, bytes(4))
SAFETY, FILE = Write(G.SDO, 0x9C01_0001, b"x"), ReadWrite(G.FOE_OPEN_WRITE, 0, 4, b"x.bin")


@pytest.mark.parametrize(
    ("endpoint", "operation", "target", "rule"),
    [
        (LAPTOP, POSITION, "press/bus0/1001", "engineers allows"),
        (LAPTOP, SAFETY, "press/bus0/1001", "safety refuses"),
        (SERVER, POSITION, "press/bus0/1001", "recipes allows"),
        (SERVER, POSITION, "press/bus0/1002", "no rule allows"),
        (SERVER, Write(G.SDO, 0x607A_0100, b""), "press/bus0/1001", "recipes allows"),
        (SERVER, Write(G.SDO, 0x6040_0000, b""), "press/bus0/1001", "no rule allows"),
        (NEIGHBOUR, FILE, "press/bus0/1001", "updates allows"),
        (NEIGHBOUR, POSITION, "press/bus0/1001", "no rule allows"),
        (Endpoint("mqtt:line", "9.9.9.9.1.1"), READ, "press/bus0/1001", "no-broker refuses"),
        (Endpoint("ams-tcp", "10.9.9.9:1"), READ, "press/eap0", "no rule refuses"),
        (Endpoint("ams-tcp", "127.0.0.1:1"), FILE, "press/eap0", "no rule refuses it to this host"),
    ],
)
def test_access_page_rules_decide_as_described(
    tmp_path: Path, endpoint: Endpoint, operation: Operation, target: str, rule: str
) -> None:
    copy(ROOT / "config" / "buses" / "drive.yaml", tmp_path)
    (tmp_path / "cell.yaml").write_text(PLANT)
    loaded = load_plant(tmp_path / "cell.yaml")
    assert not loaded.findings
    plant = loaded.plant
    assert plant is not None
    access = AccessList(plant.routing["press"].access)
    address = Directory(plant.directory).find(target)
    source = NetId.parse("10.0.7.20.1.1")
    assert rule in access.grants(endpoint, source, *address).decide(operation).why
