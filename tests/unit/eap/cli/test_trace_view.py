from __future__ import annotations

from typing import Any

import msgspec
from rich.console import Console

from eap.cli.network import trace_view
from eap.control.routes import TracedPath

MAY = dict.fromkeys(("read", "write", "control", "files", "raw"), True)
FIRST = {
    "station": "island-01",
    "net_id": "127.0.1.1.1.1",
    "opaque": False,
    "route": "island-03",
    "transport": "udp:eap0",
    "address": "127.0.1.3:34980",
    "state": "up",
    "why": "",
    "may": MAY,
    "took_us": 80,
    "spent_us": 80,
}
LAST = FIRST | {
    "station": "island-03",
    "net_id": "127.0.1.3.1.1",
    "route": "",
    "may": MAY | {"write": False, "raw": False, "files": None},
    "took_us": 1500,
    "spent_us": 1420,
}
FOUND = {
    "target": "island-03/bus0/1001",
    "address": "127.0.1.3.3.1:1001",
    "name": "island-03/bus0/drive",
    "ok": True,
    "why": "",
    "hops": [FIRST, LAST],
    "answer": {"error": 0, "text": "", "ads_state": 5, "device_state": 8, "took_us": 1800},
}


def lines(found: dict[str, Any]) -> list[list[str]]:
    console = Console(width=110, highlight=False)
    with console.capture() as capture:
        for part in trace_view(msgspec.convert(found, TracedPath)):
            console.print(part)
    return [line.split() for line in capture.get().splitlines() if line.strip()]


def test_trace_prints_a_complete_path() -> None:
    head, _, _, first, last, target, rules = lines(FOUND)
    assert " ".join(head) == "island-03/bus0/1001 (island-03/bus0/drive) is 127.0.1.3.3.1:1001"
    assert " ".join(first) == (
        "1 island-01 127.0.1.1.1.1 80 µs 80 µs island-03: udp:eap0 to 127.0.1.3:34980 (up)"
    )
    assert " ".join(last) == "2 island-03 127.0.1.3.1.1 1.5 ms 1.4 ms local"
    assert " ".join(target) == "target 1.8 ms answers: RUN, device state 8"
    assert " ".join(rules) == "island-03: its access rules refuse write, raw"


def test_trace_prints_faults_of_a_slave_once() -> None:
    fault = "island-03/bus0: drive (1001): 2 mailbox requests without reply in time"
    found = FOUND | {"hops": [FIRST, LAST | {"faults": [fault]}]}
    assert " ".join(lines(found)[-1]) == fault
    failed = lines(found | {"why": f"island-03: the slave does not answer; {fault}"})
    assert sum("mailbox" in line for line in failed) == 1


def test_trace_of_a_path_that_ends_before_its_target_fails() -> None:
    hops = [FIRST | {"route": "", "why": "no route"}]
    found = FOUND | {"hops": hops, "answer": None, "why": "island-01: no route", "name": ""}
    *_, hop, why = lines(found)
    assert " ".join(hop[-3:]) == "has no route"
    assert " ".join(why) == "not reached: island-01: no route"


def test_a_router_that_is_not_ours_and_an_error() -> None:
    opaque = FIRST | {"opaque": True, "may": {}}
    error = FOUND["answer"] | {"error": 0x701, "text": "error 0x701"}
    *_, hop, target = lines(FOUND | {"hops": [opaque], "answer": error})
    assert " ".join(hop[-5:]) == "does not report its routes"
    assert " ".join(target) == "target 1.8 ms answers: error 0x701"
    unknown = FOUND["answer"] | {"ads_state": 99}
    assert lines(FOUND | {"hops": [opaque], "answer": unknown})[-1][-4] == "99,"


def test_trace_names_the_router_that_restores_subscriptions() -> None:
    first = FIRST | {"interrupted": 20, "interrupted_s": 12}
    text = " ".join(lines(FOUND | {"hops": [first, LAST | {"interrupted": 0}]})[-1])
    assert text == "island-01: 20 subscriptions interrupted for 12 s"
