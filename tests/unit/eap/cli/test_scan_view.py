from __future__ import annotations

from typing import Any

import msgspec
from rich.console import Console

from eap.cli.network import client_line, fault_lines, scan_table
from eap.control.routes import PlantScan

BUS = {
    "name": "bus0",
    "kind": "bus",
    "net_id": "127.0.1.1.3.1",
    "interface": "sim://x.yaml",
    "slaves": [
        {"address": 1001, "name": "drive", "state": "OP"},
        {"address": 1002, "name": "io", "state": None},
    ],
    "error": "",
}
STATION = {"name": "island-01", "net_id": "127.0.1.1.1.1", "ports": [BUS], "error": ""}
DEAD = {"name": "i2", "net_id": "127.0.1.2.1.1", "ports": [BUS | {"error": "down"}], "error": "7"}


def answer(*stations: dict[str, Any], address: str = "127.0.1.1") -> dict[str, Any]:
    return {"stations": [*stations], "via": {"station": "island-01", "address": address}}


def lines(found: dict[str, Any], width: int = 200) -> list[str]:
    console = Console(width=width, highlight=False)
    with console.capture() as capture:
        console.print(scan_table(msgspec.convert(found, PlantScan)))
    return [line.rstrip() for line in capture.get().splitlines()]


def test_scan_lists_names_addresses_and_lines_to_paste() -> None:
    _, _, *rows = lines(answer(STATION))
    paste = 'pyads.Connection("127.0.1.1.{}.1", {}, "127.0.1.1")'
    assert rows[0].split()[:3] == ["island-01", "router", "127.0.1.1.1.1:10000"]
    assert rows[0].endswith(paste.format(1, 10000))
    assert rows[1].split()[:4] == ["island-01/bus0", "bus", "sim://x.yaml", "127.0.1.1.3.1:65535"]
    assert rows[2].split()[:4] == ["island-01/bus0/1001", "drive", "OP", "127.0.1.1.3.1:1001"]
    assert rows[3].split()[:3] == ["island-01/bus0/1002", "io", "?"]
    assert rows[3].endswith(paste.format(3, 1002))


def test_scan_leaves_out_lines_to_paste_that_would_wrap() -> None:
    shown = lines(answer(STATION), 80)
    assert max(map(len, shown)) <= 80
    assert len(shown) == 7
    assert shown[-1] == "not shown for lack of width: pyads"
    assert "127.0.1.1.3.1:1002" in shown[5]


def test_scan_names_what_did_not_answer() -> None:
    assert list(fault_lines(msgspec.convert(answer(STATION, DEAD), PlantScan).stations)) == [
        "i2: 7",
        "i2/bus0: down",
    ]
    assert lines(answer(DEAD))[2].split()[:3] == ["i2", "router", "?"]
    assert len(lines(answer())) == 2


def test_scan_without_ams_tcp_has_nothing_to_paste() -> None:
    assert client_line("127.0.1.1.3.1", 1001, "") == ""
    assert "pyads.Connection" not in "".join(lines(answer(STATION, address="")))
