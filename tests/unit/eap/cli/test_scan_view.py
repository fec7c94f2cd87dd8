from __future__ import annotations

from typing import Any

from eap.cli.scan_view import client_line, fault_lines, scan_lines

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


def test_every_line_can_be_pasted() -> None:
    assert (
        "\n".join(scan_lines(answer(STATION)))
        == """\
island-01            router                  pyads.Connection("127.0.1.1.1.1", 10000, "127.0.1.1")
island-01/bus0         bus sim://x.yaml      pyads.Connection("127.0.1.1.3.1", 65535, "127.0.1.1")
island-01/bus0/1001      drive           OP  pyads.Connection("127.0.1.1.3.1", 1001, "127.0.1.1")
island-01/bus0/1002      io              ?   pyads.Connection("127.0.1.1.3.1", 1002, "127.0.1.1")"""
    )


def test_who_did_not_answer() -> None:
    assert list(fault_lines(answer(STATION, DEAD))) == ["i2: 7", "i2/bus0: down"]
    assert next(scan_lines(answer(DEAD))).split()[:3] == ["i2", "router", "?"]
    assert list(scan_lines(answer())) == []


def test_without_ams_tcp_there_is_only_an_address() -> None:
    assert client_line("127.0.1.1.3.1", 1001, "") == "127.0.1.1.3.1:1001"
