"""Plant files of any size, in the manner of ``config/solar-line.yaml``."""

from __future__ import annotations

from typing import Any

import msgspec

BELT_SIZE = 592
CAMERA_SIZE = 1012
CONTROL = "control"
_TIMEOUT_MS = 200


def line(islands: int, cycle_us: int, *, generated: bool = True) -> bytes:
    """Return a plant of *islands* in a line, and a control station that talks to each of them.

    Neighbours send each other 600 octets, islands and control 1024.  JSON is YAML, too.  Unless
    they are *generated*, values stay as the application writes them.
    """
    stations = [*(_island(number, islands) for number in range(1, islands + 1)), _control(islands)]
    if not generated:
        for station in stations:
            del station["sources"]
    plant = {
        "plant": f"line-{islands}",
        "defaults": {"cycle_us": cycle_us},
        "stations": stations,
    }
    return msgspec.json.format(msgspec.json.encode(plant))


def many_values(count: int, cycle_us: int) -> bytes:
    """Return a plant of one station whose engine computes *count* numbers in each cycle."""
    names = [f"value{number:03}" for number in range(count)]
    station = {
        "name": "values",
        "net_id": "127.0.9.1.1.1",
        "ports": [
            {
                "name": "eap0",
                "kind": "eap",
                "interface": "udp://127.0.9.1",
                "net_id": "127.0.9.1.2.1",
            }
        ],
        "variables": dict.fromkeys(names, "LREAL"),
        "sources": {
            name: {"kind": "sine", "amplitude": 1 + number, "period_ms": 1000 + 7 * number}
            for number, name in enumerate(names)
        },
    }
    plant = {"plant": "values", "defaults": {"cycle_us": cycle_us}, "stations": [station]}
    return msgspec.json.format(msgspec.json.encode(plant))


def _name(number: int) -> str:
    return f"island-{number:03}"


def _station(name: str, address: str, more: dict[str, Any]) -> dict[str, Any]:
    port = {
        "name": "eap0",
        "kind": "eap",
        "interface": f"udp://{address}",
        "net_id": f"{address}.2.1",
    }
    return {"name": name, "net_id": f"{address}.1.1", "ports": [port], **more}


def _island(number: int, islands: int) -> dict[str, Any]:
    neighbours = {
        side: _name(other)
        for side, other in (("left", number - 1), ("right", number + 1))
        if 1 <= other <= islands
    }
    opposite = {"left": "right", "right": "left"}
    frames = [{"name": side, "port": "eap0", "to": f"{n}/eap0"} for side, n in neighbours.items()]
    frames.append({"name": CONTROL, "port": "eap0", "to": f"{CONTROL}/eap0"})
    publish = [
        _pd(f"to-{side}", side, 1 + (side == "right"), ["pieces", "temperature", "belt"])
        for side in neighbours
    ]
    publish.append(_pd("report", CONTROL, 3, ["pieces", "temperature", "position", "camera"]))
    subscribe = [_rx(side, f"{n}/to-{opposite[side]}") for side, n in neighbours.items()]
    subscribe.append(_rx(CONTROL, f"{CONTROL}/to-{number:03}"))
    more = {
        "variables": {
            "pieces": "UDINT",
            "temperature": "REAL",
            "belt": f"BLOCK({BELT_SIZE})",
            "position": "REAL",
            "camera": f"BLOCK({CAMERA_SIZE})",
        },
        "sources": {
            "pieces": {"kind": "counter"},
            "temperature": {"kind": "sine", "amplitude": 12.5, "period_ms": 10000},
            "belt": {"kind": "random", "seed": 1},
            "position": {"kind": "ramp", "low": 0, "high": 1500, "period_ms": 2000},
            "camera": {"kind": "random", "seed": 2},
        },
        "frames": frames,
        "publish": publish,
        "subscribe": subscribe,
    }
    # 250 to a network, and none of them the addresses that plants come with.
    block, rest = divmod(number - 1, 250)
    return _station(_name(number), f"127.0.{10 + block}.{rest + 1}", more)


def _control(islands: int) -> dict[str, Any]:
    numbers = range(1, islands + 1)
    more = {
        "variables": {"command": f"BLOCK({CAMERA_SIZE + 12})"},
        "sources": {"command": {"kind": "random", "seed": 3}},
        "frames": [{"name": f"{n:03}", "port": "eap0", "to": f"{_name(n)}/eap0"} for n in numbers],
        "publish": [_pd(f"to-{n:03}", f"{n:03}", 100 + n, ["command"]) for n in numbers],
        "subscribe": [_rx(_name(n), f"{_name(n)}/report") for n in numbers],
    }
    return _station(CONTROL, "127.0.9.1", more)


def _pd(name: str, frame: str, pd_id: int, variables: list[str]) -> dict[str, Any]:
    return {"name": name, "frame": frame, "id": pd_id, "version": 1, "variables": variables}


def _rx(name: str, source: str) -> dict[str, Any]:
    return {"name": name, "port": "eap0", "from": source, "timeout_ms": _TIMEOUT_MS}
