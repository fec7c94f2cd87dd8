"""Access rules of a running station: who is on a cable reads, and writes what a rule opens."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from shutil import copy
from typing import Any, NamedTuple

import pytest

from eap.codec.ethercat import ETHERTYPE
from eap.ids import MacAddr
from tests.support import aoe
from tests.support.amsclient import AmsClient
from tests.support.appliance import Appliance, Plants, wait_until
from tests.support.namespaces import Namespace, cable

pytestmark = [pytest.mark.net, pytest.mark.root]

STATION, TOOL, OTHER = "10.88.164.1", "10.88.164.2", "10.88.164.3"
BUS = "5.1.1.1.3.1"
PLANT = f"""\
plant: cell
defaults: {{cycle_us: 10000}}
stations:
  - name: press
    net_id: 5.1.1.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{STATION}", net_id: 5.1.1.1.2.1}}
      - {{name: eap1, kind: eap, interface: "ethernet://line0", net_id: 5.1.1.1.2.2}}
      - {{name: bus0, kind: bus, interface: "sim://drive.yaml", net_id: {BUS}}}
    access:
      - name: recipes
        allow: [write]
        from: [{TOOL}/32]
        to: [press/bus0/1001]
        objects: [0x6060-0x6067]
"""
BUSES = Path(__file__).parents[2] / "config" / "buses"
READ_WRITE, SUM_WRITE = 9, 0xF081
OPEN, CLOSED = 0x6065_0000, 0x8000_0001


class Cell(NamedTuple):
    """The station, what is at the other end of its cable, and the file of its audit.

    Attributes:
        recorded: Lines of the audit when the test began.
    """

    appliance: Appliance
    here: Namespace
    there: Namespace
    file: Path
    recorded: int = 0

    def lines(self) -> list[str]:
        return self.file.read_text().splitlines() if self.file.exists() else []

    def audit(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.lines()[self.recorded :]]


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> Iterator[Cell]:
    copy(BUSES / "drive.yaml", module_farm.folder / "drive.yaml")
    plant = module_farm.write(PLANT)
    with cable(addresses=True) as (here, there):
        there.ip("addr", "add", f"{OTHER}/24", "dev", "line0")
        appliance = module_farm.run(plant, prefix=here.prefix)
        appliance.request("bus_describe", station="press", port="bus0", wait=True)
        wait_until(lambda: appliance.request("trace", target="press/bus0/1001")["answer"])
        file = module_farm.folder / "state" / "cell" / "audit.jsonl"
        yield Cell(appliance, here, there, file)


@pytest.fixture
def cell(shared: Cell) -> Cell:
    return shared._replace(recorded=len(shared.lines()))


def client(place: Namespace, source: str = "") -> AmsClient:
    sock = place.socket(socket.AF_INET, socket.SOCK_STREAM)
    if source:
        sock.bind((source, 0))
    return AmsClient(STATION, sock)


def ask(who: AmsClient, command: int, body: bytes) -> tuple[int, bytes]:
    return who.ask(BUS, command, body, port=1001)


def write(who: AmsClient, offset: int, value: int) -> int:
    """Return the error or the result of a write."""
    error, data = ask(who, aoe.WRITE, aoe.write_body(offset, struct.pack("<I", value)))
    return error or int.from_bytes(data, "little")


def read(who: AmsClient, offset: int) -> int:
    error, data = ask(who, aoe.READ, aoe.read_body(offset, 4))
    assert (error, data[:8]) == (0, struct.pack("<II", 0, 4))
    return int.from_bytes(data[8:], "little")


def test_a_rule_opens_one_range_of_objects_for_one_address(cell: Cell) -> None:
    with client(cell.there, TOOL) as tool, client(cell.there, OTHER) as other:
        before = read(other, CLOSED)
        assert read(tool, CLOSED) == before
        assert write(tool, OPEN, 4711) == 0
        assert write(tool, CLOSED, before + 1) == 0x723
        assert write(other, OPEN, 1) == 0x723
        assert read(other, OPEN) == 4711
        assert read(other, CLOSED) == before
    with client(cell.here) as own:
        assert write(own, CLOSED, before + 1) == 0
        assert read(own, CLOSED) == before + 1
    told = [(line["from"].partition(":")[0], line["object"], line["result"], line["why"])
            for line in cell.audit()]  # fmt: skip
    nobody = "no rule allows it, and other hosts only read"
    assert told == [
        (TOOL, "0x6065:00", 0, "rule recipes allows it"),
        (TOOL, "0x8000:01", 0x723, nobody),
        (OTHER, "0x6065:00", 0x723, nobody),
        (STATION, "0x8000:01", 0, "no rule refuses it to this host"),
    ]
    assert {line["name"] for line in cell.audit()} == {"press/bus0/drive"}
    wait_until(lambda: f"{BUS}:1001 for {aoe.CLIENT}:33000 ({OTHER}:" in cell.appliance.log())
    assert f"write refused: {nobody} (0x723)" in cell.appliance.log()


def test_a_sum_command_is_judged_item_by_item(cell: Cell) -> None:
    heads = b"".join(struct.pack("<III", aoe.SDO, offset, 4) for offset in (OPEN, CLOSED, OPEN))
    values = struct.pack("<III", 1, 2, 3)
    items = heads + values
    body = struct.pack("<IIII", SUM_WRITE, 3, 12, len(items)) + items
    with client(cell.there, TOOL) as tool, client(cell.there, OTHER) as other:
        assert ask(tool, READ_WRITE, body) == (0, struct.pack("<5I", 0, 12, 0, 0x723, 0))
        assert ask(other, READ_WRITE, body) == (0, struct.pack("<5I", 0, 12, *[0x723] * 3))
        assert read(tool, OPEN) == 3
    assert [line["result"] for line in cell.audit()] == [0, 0x723, 0, 0x723, 0x723, 0x723]


def test_a_neighbour_on_the_cable_reads_by_type_5_and_does_not_write(cell: Cell) -> None:
    station = bytes(MacAddr.parse(cell.here.mac()))
    with cell.there.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE)) as line:
        line.bind(("line0", ETHERTYPE))
        line.settimeout(5)
        own = bytes(MacAddr.parse(cell.there.mac()))

        def ask_by_frame(command: int, body: bytes) -> aoe.Answer:
            frame = aoe.frame(aoe.packet(BUS, command, body, port=1001))
            header = station + own + ETHERTYPE.to_bytes(2, "big")
            line.send((header + frame).ljust(60, b"\0"))
            return aoe.answer(line.recv(2048)[14:])

        answer = ask_by_frame(aoe.READ, aoe.read_body(OPEN, 4))
        assert (answer.error, answer.result) == (0, 0)
        assert ask_by_frame(aoe.WRITE, aoe.write_body(OPEN, bytes(4))).error == 0x723
    (told,) = cell.audit()
    assert (told["transport"], told["from"]) == ("ethernet:eap1", cell.there.mac())
