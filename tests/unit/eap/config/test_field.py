"""The keys ``s7`` and ``modbus``, sources and targets in controllers, and computed addresses."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest

from eap.config.bridge_sections import FieldServer, ModbusBridge, S7Bridge
from eap.config.index import ExpectedBus
from eap.config.load import Plant, PlantResult, load
from eap.pd.spec import S7Source, S7Target, Substitute, Writer

KEYS = """\
s7:
  controllers:
    press: {host: 10.0.0.9, every_ms: 50, timeout_ms: 400, substitute: zero}
modbus:
  controllers: {meter: 10.0.0.10}
"""
STATION = """\
plant: line
%(keys)s
stations:
  - name: mill
    net_id: 10.0.0.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.0.0.1", net_id: 10.0.0.1.2.1}]
    variables: {temp: REAL, on: BOOL, ready: BOOL, level: USINT, setpoint: REAL, name: STRING(5),
                axis: Axis, limits: "REAL[2]", copy: REAL, total: LINT}
    links: [{from: temp, to: copy}]
    sources: {%(sources)s}
    targets: {%(targets)s}
types: {Axis: {members: {moving: BOOL, position: REAL}}}
"""
TEMP = "temp: {kind: s7, controller: press, address: DB1.DBD4}"


def result(
    tmp_path: Path, *, keys: str = KEYS, sources: str = TEMP, targets: str = ""
) -> PlantResult:
    file = tmp_path / "plant.yaml"
    file.write_text(STATION % {"keys": keys, "sources": sources, "targets": targets})
    return load(file, lambda path: ExpectedBus())


def findings(tmp_path: Path, **parts: str) -> list[str]:
    found = result(tmp_path, **parts).findings
    return [re.sub(r"^.*?plant.yaml:\d+: ", "", str(each)) for each in found]


def plant(tmp_path: Path, **parts: str) -> Plant:
    found = result(tmp_path, **parts)
    assert found.plant is not None, found.findings
    return found.plant


def test_sources_and_targets_become_those_of_the_station(tmp_path: Path) -> None:
    sources = TEMP + ", level: {kind: modbus, controller: meter, address: 'holding:7', type: INT}"
    targets = "setpoint: {kind: s7, controller: press, address: DB1.8, type: INT}"
    (station,) = plant(tmp_path, sources=sources, targets=targets).stations
    assert station.sources[0] == S7Source(
        "temp", "press", "DB1.DBD4", timeout_ms=400, substitute=Substitute.ZERO
    )
    assert station.sources[1].timeout_ms == 1000
    assert station.targets == (S7Target("setpoint", "press", "DB1.8", "INT"),)
    by_services = [each.name for each in station.variables if each.writer is Writer.SERVICES]
    assert by_services == [
        "temp", "level", "press.ok", "press.age_ms", "meter.ok", "meter.age_ms",
    ]  # fmt: skip


def test_state_of_a_controller_is_a_variable_like_others(tmp_path: Path) -> None:
    keys = KEYS + "web: {pages: [{name: A, panels: [{kind: value, of: mill/press.age_ms}]}]}\n"
    assert findings(tmp_path, keys=keys) == []
    targets = "press.ok: {kind: s7, controller: press, address: DB1.DBX20.0}"
    assert findings(tmp_path, targets=targets) == []


SERVER = """\
s7:
  controllers: {press: 10.0.0.9}
  server:
    blocks:
      DB7: [mill/on, mill/ready, mill/level, mill/temp, {of: mill/name, write: true}, mill/axis,
            mill/limits, {of: mill/on, address: "60.3"}, mill/total]
modbus:
  server:
    word_order: little
    holding: [mill/level, mill/temp, {of: mill/setpoint, address: 10, type: INT, write: true},
              {of: mill/on, address: "12.3", write: true}, mill/name]
    coil: ["mill/*o*n*", {of: mill/ready, address: 9}]
"""


def test_addresses_of_the_server_are_computed(tmp_path: Path) -> None:
    keys = SERVER.replace('"mill/*o*n*"', "mill/on")
    bridges = plant(tmp_path, keys=keys).bridges
    s7, modbus = bridges["s7"], bridges["modbus"]
    assert isinstance(s7, S7Bridge)
    assert isinstance(modbus, ModbusBridge)
    assert isinstance(s7.server, FieldServer)
    assert [(each.name, each.address) for each in s7.server.items] == [
        ("mill/on", "DB7.DBX0.0"),
        ("mill/ready", "DB7.DBX0.1"),
        ("mill/level", "DB7.DBB1"),
        ("mill/temp", "DB7.DBD2"),
        ("mill/name", "DB7.DBB6"),
        ("mill/axis", "DB7.DBB14"),
        ("mill/limits", "DB7.DBB20"),
        ("mill/on", "DB7.DBX60.3"),
        ("mill/total", "DB7.DBB62"),
    ]
    assert [each.write for each in s7.server.items][4:6] == [True, False]
    assert isinstance(modbus.server, FieldServer)
    assert modbus.server.words_swapped
    assert [(each.name, each.address, each.write) for each in modbus.server.items] == [
        ("mill/on", "coil:0", False),
        ("mill/ready", "coil:9", False),
        ("mill/level", "holding:0", False),
        ("mill/temp", "holding:1", False),
        ("mill/setpoint", "holding:10", True),
        ("mill/on", "holding:12.3", True),
        ("mill/name", "holding:13", False),
    ]


@pytest.mark.parametrize(
    ("parts", "part"),
    [
        ({"sources": TEMP.replace("press", "pres")},
         "unknown s7 controller 'pres', did you mean press?"),
        ({"keys": ""}, "unknown s7 controller 'press'; expected a controller of the key s7"),
        ({"sources": TEMP.replace("DB1.DBD4", "DB1.DBW4")},
         "temp: 'DB1.DBW4' has 16 bits, REAL has 32"),
        ({"sources": TEMP.replace("DB1.DBD4", "D4")}, "no S7 address"),
        ({"sources": "level: {kind: modbus, controller: meter, address: '40001'}"},
         "'40001' is no address"),
        ({"sources": "axis: {kind: modbus, controller: meter, address: 'holding:1', type: INT}"},
         "does not hold INT"),
        ({"sources": "copy: {kind: s7, controller: press, address: DB1.DBD4}"},
         "'copy' has a source (line"),
        ({"targets": "setpoint: {kind: s7, controller: press, address: DB1.DBD0},"
                     " level: {kind: s7, controller: press, address: DB1.DBB3}"},
         "DB1.DBB3 of press is written by two targets"),
        ({"targets": "setpint: {kind: s7, controller: press, address: DB1.DBD0}"},
         "no variable 'setpint', did you mean setpoint?"),
        ({"keys": KEYS.replace("timeout_ms: 400", "timeout_ms: 50")},
         "timeout_ms is 50, every_ms is 50; expected a time-out longer than the period"),
        ({"keys": KEYS.replace("10.0.0.9", "10.0.0.9:1102")}, "'10.0.0.9:1102' has a port"),
        ({"keys": KEYS.replace("meter", "press")}, "controller 'press' exists already"),
        ({"sources": TEMP + ", press.ok: {kind: counter}"}, "no variable 'press.ok'"),
    ],
)  # fmt: skip
def test_wrong_sources_and_targets_are_findings(
    tmp_path: Path, parts: dict[str, str], part: str
) -> None:
    found = findings(tmp_path, **parts)
    assert any(part in each for each in found), found


@pytest.mark.parametrize(
    ("before", "after", "part"),
    [
        ("DB7", "DB0", "data block 'DB0'; expected a number from 1 to 65535"),
        ("mill/ready, mill/level", "mill/redy", "no variable 'redy', did you mean ready?"),
        ('"60.3"', '"0.0"', "mill/on: DB7.DBX0.0 is that of mill/on, too"),
        ('"60.3"', '"60.9"', "'60.9' is a bit: expected one for BOOL"),
        ("{of: mill/name, write: true}", "{of: mill/temp, write: true}",
         "mill/temp cannot be written: it has a source"),
        ("coil: [", "coil: [mill/temp, ", "mill/temp: a variable of REAL is no single bit"),
        ("coil:", "discrete: [{of: mill/on, write: true}]\n    coil:",
         "clients cannot write discrete"),
        ("address: 10", "address: 1", "holding:1 is that of mill/temp, too"),
        ("address: 10", "address: ten", "'ten' is no address"),
        ("word_order: little", "listen: somewhere", "'somewhere' is not an address with a port"),
        ('"mill/*o*n*"', "mill/x*", "no variable fits 'mill/x*'"),
        ("type: INT", "type: ITN", "did you mean INT?"),
    ],
)  # fmt: skip
def test_wrong_servers_are_findings(tmp_path: Path, before: str, after: str, part: str) -> None:
    keys = SERVER.replace('"mill/*o*n*"', "mill/on") if before != '"mill/*o*n*"' else SERVER
    assert before in keys
    found = findings(tmp_path, keys=keys.replace(before, after))
    assert any(part in each for each in found), found


def test_server_runs_on_the_host_that_has_its_address(tmp_path: Path) -> None:
    keys = SERVER.replace(
        "  server:\n    blocks", "  server:\n    listen: 10.0.9.1:102\n    blocks"
    )
    keys = keys.replace('"mill/*o*n*"', "mill/on")
    keys += "hosts:\n  - {name: ipc1, address: 10.0.9.1, stations: [mill]}\n"
    whole = result(tmp_path, keys=keys).plant
    assert whole is not None
    here = whole.on_host(whole.hosts[0]).bridges["s7"]
    other = whole.on_host(msgspec.structs.replace(whole.hosts[0], address="10.0.9.2"))
    assert isinstance(here, S7Bridge)
    assert here.server is not None
    assert other.bridges["s7"] == msgspec.structs.replace(here, server=None)
    modbus = other.bridges["modbus"]
    assert isinstance(modbus, ModbusBridge)
    assert modbus.server is not None  # a loopback address, which each host has
