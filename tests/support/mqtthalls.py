"""Two halls that have a broker in common: plant files, and a tool that reads their drives."""

from __future__ import annotations

import socket
import struct
from pathlib import Path

from tests.support.aoe import packet, read_body
from tests.support.appliance import wait_until
from tests.support.namespaces import Namespace

ROOT = Path(__file__).parents[2]
BROKER = "127.0.5.9"
NORTH, SOUTH = "127.0.5.1", "127.0.5.2"
VENDOR, VENDOR_OF_DRIVE = 0x10180001, 3674
READ = 2
PLANT = """\
plant: {name}
defaults: {{cycle_us: 10000}}
stations:
  - name: {name}
    net_id: {address}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{address}", net_id: {address}.2.1}}
      - {{name: bus0, kind: bus, interface: "sim://{drive}", net_id: {address}.3.1}}
    routes:
      - {{{broker}, network: works}}
"""


def write_plant(folder: Path, name: str, address: str, broker: str = "") -> Path:
    """Write the plant file of one hall, which names no other one."""
    text = PLANT.format(
        name=name,
        address=address,
        drive=ROOT / "config" / "buses" / "drive.yaml",
        broker=broker or f'mqtt: "mqtt://{BROKER}"',
    )
    path = folder / f"{name}.yaml"
    path.write_text(text)
    return path


def read(address: str, by: str, offset: int = VENDOR, *, inside: Namespace | None = None) -> int:
    """Return an object of the first slave at *address*, asked by a tool at *by*.

    What cannot be read is its error code, below zero.
    """
    asked = packet(f"{address}.3.1", READ, read_body(offset, 4), port=1001)
    kind = socket.AF_INET, socket.SOCK_STREAM
    with socket.socket(*kind) if inside is None else inside.socket(*kind) as connection:
        connection.settimeout(10)
        connection.connect((by, 48898))
        connection.sendall(struct.pack("<HI", 0, len(asked)) + asked)
        with connection.makefile("rb") as stream:
            _, length = struct.unpack("<HI", stream.read(6))
            answer = stream.read(length)
    error, body = int.from_bytes(answer[24:28], "little"), answer[32:]
    if error or not body:
        return -error
    result, size = struct.unpack_from("<II", body)
    return -result if result else int.from_bytes(body[8 : 8 + size], "little")


def until_read(address: str, by: str, *, inside: Namespace | None = None) -> None:
    """Wait until the drive at *address* answers a tool at *by*."""
    wait_until(lambda: read(address, by, inside=inside) == VENDOR_OF_DRIVE)
