from __future__ import annotations

import msgspec
from rich.console import Console

from eap.cli.gateway import gateway_view
from eap.control.bus import GatewayRow

ROW = {
    "station": "mixer",
    "port": "bus0",
    "served": ["udp://10.0.0.1:34980", "tcp://10.0.0.1:34980"],
    "state": "running",
    "dropped": 0,
    "settings": {
        "answer_ms": 900, "silent": False, "in_flight": 32, "rate": 0, "clients": 256,
    },
    "clients": [
        {
            "transport": "udp:eap0", "address": "10.0.0.9:5000", "requests": 7, "repeated": 1,
            "errors": 2, "waiting": 0, "transfers": [{"address": 1001, "protocol": "FOE"}],
        }
    ],
    "slaves": [
        {
            "address": 0, "protocol": "COE", "requests": 5, "replies": 5, "errors": {},
            "last_error": "", "mean_us": 1200.0, "slowest_us": 3000.0, "name": "",
        },
        {
            "address": 1009, "protocol": "SOE", "requests": 2, "replies": 0,
            "errors": {"no_slave": 2}, "last_error": "there is no such slave", "mean_us": None,
            "slowest_us": 0.0, "name": "",
        },
        {
            "address": 0x9001, "protocol": "COE", "requests": 1, "replies": 0,
            "errors": {"timeout": 1}, "last_error": "it did not answer in time", "mean_us": None,
            "slowest_us": 0.0, "name": "press/bus0/1001",
        },
    ],
}  # fmt: skip


def shown(row):
    console = Console(width=120)
    with console.capture() as captured:
        for each in gateway_view(msgspec.convert(row, GatewayRow)):
            console.print(each)
    return captured.get()


def test_gateway_view_shows_clients_and_requests():
    text = shown(ROW)
    first, *lines = text.splitlines()
    assert first == (
        "mixer/bus0: running at udp://10.0.0.1:34980, tcp://10.0.0.1:34980; answers within 900 ms"
    )
    assert any(
        s.split() == ["10.0.0.9:5000", "udp:eap0", "7", "1", "2", "FOE", "1001"] for s in lines
    )
    assert any("master" in each and "1.2 ms" in each for each in lines)
    assert "there is no such slave" in text
    assert "0x9001 (press/bus0/1001)" in text


def test_gateway_view_of_many_clients_shows_the_latest_and_those_with_transfers():
    (busy,) = ROW["clients"]
    idle = [busy | {"address": f"10.0.0.9:{port}", "transfers": []} for port in range(6000, 6020)]
    text = shown(ROW | {"clients": [busy, *idle]})
    ports = [line.split()[0][-4:] for line in text.splitlines() if "10.0.0.9:" in line]
    assert ports == [*(str(port) for port in range(6019, 6009, -1)), "5000"]
    assert "10 earlier clients not shown (--json shows them)" in text


def test_gateway_view_of_a_stopped_silent_gateway():
    quiet = ROW | {"state": "stopped", "dropped": 3, "served": [], "clients": [], "slaves": []}
    quiet["settings"] = ROW["settings"] | {"silent": True}
    assert shown(quiet) == (
        "mixer/bus0: stopped at no socket; answers within 900 ms, silent, 3 frames dropped\n"
    )
