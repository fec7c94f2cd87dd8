"""Values by MQTT of a plant that runs: mosquitto, its clients, and sparkplug-payload of npm."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Appliance, Plants, plants
from tests.support.eventually import wait_until
from tests.support.mosquitto import Broker, broker, write_certificates, write_passwords
from tests.support.mqttlisten import (
    Heard,
    Listener,
    decode_sparkplug,
    encode_sparkplug,
    listen,
    publish,
)
from tests.support.npm import needs_npm

pytestmark = [pytest.mark.net, pytest.mark.mosquitto]

BROKER = "127.9.73.9"
COUNTERS = 40
PLANT = f"""\
plant: cell
defaults: {{cycle_us: 10000}}
types:
  E_State: {{base: INT, values: {{Stopped: 0, Moving: 1}}}}
  ST_Axis: {{members: {{pos: REAL, state: E_State}}}}
stations:
  - name: mixer
    net_id: 127.9.73.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.9.73.1", net_id: 127.9.73.1.2.1}}
    variables:
      speed: {{type: REAL, unit: 1/min}}
      setpoint: {{type: INT, unit: degC, default: 40}}
      axis: ST_Axis
      curve: REAL[2]
    frames: [{{name: out, port: eap0, to: mill/eap0}}]
    publish: [{{name: state, frame: out, id: 1, variables: [speed, setpoint]}}]
    access: [{{name: commands, allow: [write], transports: [mqtt]}}]
  - name: mill
    net_id: 127.9.73.2.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.9.73.2", net_id: 127.9.73.2.2.1}}
    variables:
      locked: INT
      {", ".join(f"n{i}: UDINT" for i in range(COUNTERS)).replace(", ", chr(10) + "      ")}
    sources: {{{", ".join(f"n{i}: {{kind: counter}}" for i in range(COUNTERS))}}}
    subscribe: [{{name: from-mixer, port: eap0, from: mixer/state, timeout_ms: 200}}]
mqtt:
  broker: mqtt://{BROKER}
  period_ms: 50
  qos: 1
  commands: [mixer/*, mill/locked]
  home_assistant: true
  sparkplug: works
"""


class Cell:
    """The plant, its broker, and a listener that heard all."""

    def __init__(self, plant: Appliance, server: Broker, heard: Listener) -> None:
        self.plant = plant
        self.broker = server
        self.heard = heard

    def bridge(self) -> dict[str, Any]:
        """Return the state of the bridge in ``status``."""
        found: dict[str, Any] = self.plant.status()["processes"]["mqtt"]["bridge"]
        return found

    def last(self, topic: str, since: int = 0) -> Any:
        """Return the latest JSON payload on a topic, None without one."""
        found = self.heard.payloads(topic, since)
        return found[-1] if found else None

    def cycle_losses(self) -> list[int]:
        return [self.plant.rx("mill", "from-mixer")[key] for key in ("lost", "late", "timeouts")]


@pytest.fixture(scope="module")
def folder() -> Iterator[Plants]:
    with plants() as found:
        yield found


@pytest.fixture(scope="module")
def cell(folder: Plants, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    with (
        broker(tmp_path_factory.mktemp("broker"), BROKER) as server,
        listen(BROKER) as heard,
    ):
        found = Cell(folder.run(folder.write(PLANT)), server, heard)
        wait_until(lambda: found.last("cell/mixer/speed") and found.last("cell/mill/n0"))
        wait_until(lambda: [m for m in heard.messages if "/DDATA/cell/mill" in m.topic])
        yield found


def test_values_are_retained_json_with_unit_quality_and_time(cell: Cell):
    value = cell.last("cell/mixer/setpoint")
    assert value.keys() == {"value", "unit", "quality", "time"}
    assert (value["value"], value["unit"], value["quality"]) == (40, "degC", "good")
    assert cell.last("cell/mixer/axis")["value"] == {"pos": 0.0, "state": "Stopped"}
    assert cell.last("cell/mixer/curve")["value"] == [0.0, 0.0]
    assert cell.last("cell/mill/from-mixer.setpoint")["value"] == 40  # received by EAP
    counts = [each["value"] for each in cell.heard.payloads("cell/mill/n0")]
    assert counts == sorted(set(counts))
    with listen(BROKER, "cell/#", "--retained-only") as late:
        wait_until(lambda: late.payloads("cell/mixer/speed"))
        assert late.texts("cell/status") == ["online"]


def test_home_assistant_finds_a_device_for_each_station(cell: Cell):
    document = cell.last("homeassistant/device/eap_cell_mixer/config")
    setpoint = document["components"]["setpoint"]
    assert setpoint["command_topic"] == "cell/mixer/setpoint/set"
    assert setpoint["unit_of_measurement"] == "°C"
    assert cell.last("homeassistant/device/eap_cell_mill/config")["components"].keys() >= {"n0"}


def command(cell: Cell, variable: str, payload: bytes, *words: str) -> dict[str, Any]:
    """Send a command; return its result."""
    since = len(cell.heard.messages)
    publish(BROKER, f"cell/{variable}/set", payload, *words)
    wait_until(lambda: cell.last(f"cell/{variable}/result", since))
    result: dict[str, Any] = cell.last(f"cell/{variable}/result", since)
    return result


def test_command_is_done_by_rule_answered_and_audited(cell: Cell):
    result = command(cell, "mixer/setpoint", b'{"value": 55, "id": "a7"}')
    assert (result["ok"], result["value"], result["id"]) == (True, 55, "a7")
    wait_until(lambda: cell.last("cell/mixer/setpoint")["value"] == 55)
    wait_until(lambda: cell.last("cell/mill/from-mixer.setpoint")["value"] == 55)
    axis = {"pos": 1.5, "state": "Moving"}
    assert command(cell, "mixer/axis", json.dumps(axis).encode())["ok"]
    wait_until(lambda: cell.last("cell/mixer/axis")["value"] == axis)
    audit = Path(cell.plant.status()["audit"]["file"]).read_text().splitlines()
    lines = [json.loads(line) for line in audit]
    (line,) = [each for each in lines if each.get("by") == "mqtt:cell/mixer/setpoint/set"]
    assert line["asked"]["values"] == {"setpoint": 55}


def test_command_that_no_rule_allows_is_refused_with_the_reason(cell: Cell):
    before = cell.bridge()["refused"]
    result = command(cell, "mill/locked", b"1")
    assert not result["ok"]
    assert "no rule allows it, and other hosts only read" in result["error"]
    assert "not a value of INT" in command(cell, "mixer/setpoint", b"70000")["error"]
    assert "not JSON" in command(cell, "mixer/setpoint", b"hot")["error"]
    wait_until(lambda: cell.bridge()["refused"] == before + 3)


def test_retained_command_is_refused(cell: Cell):
    # A broker tells new subscribers only that a message was retained: so the bridge has to connect
    # again while there is one.
    publish(BROKER, "cell/mixer/setpoint/set", b"99", "-r")
    try:
        wait_until(lambda: cell.last("cell/mixer/setpoint")["value"] == 99)  # live: done once
        assert command(cell, "mixer/setpoint", b"41")["ok"]
        since, pid = len(cell.heard.messages), cell.plant.status()["processes"]["mqtt"]["pid"]
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: cell.last("cell/mixer/setpoint/result", since))
        assert "retained" in cell.last("cell/mixer/setpoint/result", since)["error"]
        wait_until(lambda: cell.last("cell/mixer/setpoint", since))
        assert cell.last("cell/mixer/setpoint")["value"] == 41
    finally:
        publish(BROKER, "cell/mixer/setpoint/set", b"", "-r")


def test_bridge_that_is_killed_is_announced_by_the_broker_and_comes_back(cell: Cell):
    losses, since = cell.cycle_losses(), len(cell.heard.messages)
    pid = cell.plant.status()["processes"]["mqtt"]["pid"]
    os.kill(pid, signal.SIGKILL)
    wait_until(lambda: cell.heard.texts("cell/status", since) == ["offline", "online"])
    wait_until(lambda: cell.last("cell/mill/n0", since))
    assert cell.cycle_losses() == losses


def test_broker_outage_costs_the_plant_nothing_and_values_are_fresh_afterwards(cell: Cell):
    losses = cell.cycle_losses()
    cell.broker.stop()
    wait_until(lambda: not cell.bridge()["is_up"])
    assert "Errno" not in cell.bridge()["reason"]
    (finding,) = [
        each for each in cell.plant.status()["findings"] if each["where"] == "cell mqtt"
        and each["severity"] == "warning"
    ]  # fmt: skip
    assert finding["what"].startswith(f"no connection to mqtt://{BROKER}:1883: ")
    lost_at = cell.plant.values("mill")["n0"]
    wait_until(lambda: cell.plant.values("mill")["n0"] > lost_at + 20)
    since = len(cell.heard.messages)
    cell.broker.start()
    wait_until(lambda: cell.heard.texts("cell/status", since) == ["online"], 40)
    wait_until(lambda: cell.last("cell/mill/n0", since) and cell.last("cell/mixer/axis", since))
    # Nothing was queued: the first value is younger than the outage.
    assert cell.heard.payloads("cell/mill/n0", since)[0]["value"] > lost_at + 20
    wait_until(lambda: cell.bridge()["is_up"])
    assert cell.cycle_losses() == losses


def test_broker_that_is_slow_loses_old_values_which_are_counted(cell: Cell):
    losses = cell.cycle_losses()
    assert cell.broker.pid
    os.kill(cell.broker.pid, signal.SIGSTOP)
    try:
        wait_until(lambda: cell.bridge()["dropped"] > COUNTERS)
    finally:
        os.kill(cell.broker.pid, signal.SIGCONT)
    count, since = cell.plant.values("mill")["n0"], len(cell.heard.messages)
    wait_until(lambda: (cell.last("cell/mill/n0", since) or {"value": 0})["value"] > count, 40)
    assert cell.cycle_losses() == losses


def sparkplug(cell: Cell, since: int = 0) -> list[Heard]:
    found = cell.heard.messages[since:]
    return [each for each in found if each.topic.startswith("spBv1.0/")]


class Host:
    """A host of Sparkplug: the state of a node by the rules, from messages decoded by npm."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {}
        self.properties: dict[str, Any] = {}
        self.aliases: dict[int, str] = {}
        self.bd_seq: int | None = None
        self.seq: int | None = None
        self.gaps = 0
        self.births = 0
        self.deaths = 0

    def take(self, topic: str, payload: dict[str, Any]) -> None:
        kind, _, *device = topic.split("/")[2:]
        metrics = payload.get("metrics", [])
        if kind == "NDEATH":
            assert "seq" not in payload or payload["seq"] in {None, 0}
            self.deaths += metrics[0]["value"] == self.bd_seq
            self.seq = None
            return
        if kind not in {"NBIRTH", "DBIRTH", "DDATA", "DDEATH"}:
            return
        if kind == "NBIRTH":
            self.births += 1
            self.seq, self.aliases, self.values = 0, {}, {}
            assert payload["seq"] == 0
            self.bd_seq = next(each["value"] for each in metrics if each["name"] == "bdSeq")
        elif self.seq is None:
            return  # a host that has not seen the birth knows no aliases
        else:
            self.seq = (self.seq + 1) % 256
            self.gaps += payload["seq"] != self.seq
        for each in metrics:
            prefix = "/".join([*device, ""])
            if each.get("name"):
                name = prefix + each["name"]
                self.aliases[each.get("alias")] = name
            else:
                name = self.aliases[each["alias"]]
            self.values[name] = each.get("value")
            self.properties[name] = each.get("properties", self.properties.get(name))


def host_of(messages: list[Heard]) -> Host:
    host = Host()
    for each in decode_sparkplug(messages):
        host.take(each["topic"], each["payload"])
    return host


@cache
def rebirth() -> bytes:
    """Return the command for a rebirth."""
    metric = {"name": "Node Control/Rebirth", "type": "Boolean", "value": True}
    return encode_sparkplug(timestamp=1, metrics=[metric])


@needs_npm("sparkplug-payload")
def test_sparkplug_host_of_npm_follows_births_data_and_commands(cell: Cell):
    since = len(cell.heard.messages)
    publish(BROKER, "spBv1.0/works/NCMD/cell", rebirth())
    wait_until(
        lambda: len([m for m in sparkplug(cell, since) if "/DBIRTH/cell/mill" in m.topic]) == 1
    )
    first = next(i for i, m in enumerate(sparkplug(cell, since)) if "/NBIRTH/" in m.topic)
    command = {"name": "setpoint", "type": "Int16", "value": -7}
    axis = {"name": "axis", "type": "Template", "value": {
        "isDefinition": False, "templateRef": "ST_Axis",
        "metrics": [{"name": "pos", "type": "Float", "value": 2.5}],
    }}  # fmt: skip
    topic = "spBv1.0/works/DCMD/cell/mixer"
    publish(BROKER, topic, encode_sparkplug(timestamp=1, metrics=[command, axis]))
    wait_until(lambda: cell.last("cell/mixer/axis")["value"]["pos"] == 2.5)
    last = len(sparkplug(cell, since))
    wait_until(lambda: len(sparkplug(cell, since)) > last + 20)
    host = host_of(sparkplug(cell, since)[first:])
    assert (host.births, host.gaps) == (1, 0)
    assert host.values["mixer/setpoint"] == -7
    assert host.values["mixer/axis"]["templateRef"] == "ST_Axis"
    members = {each["name"]: each["value"] for each in host.values["mixer/axis"]["metrics"]}
    # The member that the command lacks keeps its value.
    assert members == cell.last("cell/mixer/axis")["value"]
    assert members["pos"] == 2.5
    assert host.values["mixer/curve"]["columns"] == ["value"]
    assert host.values["mixer/curve"]["rows"] == [[0], [0]]
    assert host.values["mill/n0"] > 20
    assert host.properties["mixer/setpoint"]["Quality"]["value"] == 192


@needs_npm("sparkplug-payload")
def test_sparkplug_death_has_the_number_of_the_birth(cell: Cell):
    since = len(cell.heard.messages)
    publish(BROKER, "spBv1.0/works/NCMD/cell", rebirth())
    wait_until(lambda: [m for m in sparkplug(cell, since) if "/NBIRTH/" in m.topic])
    os.kill(cell.plant.status()["processes"]["mqtt"]["pid"], signal.SIGKILL)
    wait_until(lambda: [m for m in sparkplug(cell, since) if "/NDEATH/" in m.topic])
    wait_until(lambda: [m for m in sparkplug(cell, since) if "/NBIRTH/" in m.topic][1:])
    host = host_of(sparkplug(cell, since))
    assert (host.births, host.deaths) == (2, 1)


SECURE = """\
plant: safe
stations:
  - name: mixer
    net_id: 127.9.73.3.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://127.9.73.3", net_id: 127.9.73.3.2.1}}]
    variables: {{setpoint: {{type: INT, default: 7}}}}
    routes:
      - {{mqtt: "mqtts://{address}:8883", network: works, user: mixer,
         password_file: {folder}/secret, tls: {{ca: {folder}/ca.pem}}}}
mqtt: works
"""


def test_broker_of_a_route_is_used_with_its_tls_and_login(folder: Plants, tmp_path: Path):
    address = "127.9.73.8"
    files = write_certificates(tmp_path, address)
    passwords = write_passwords(tmp_path, mixer="correct", panel="horse")
    (tmp_path / "secret").write_text("wrong\n")
    login = ("-p", "8883", "--cafile", str(files["ca"]), "-u", "panel", "-P", "horse")
    settings = (f"cafile {files['ca']}", f"certfile {files['broker']}",
                f"keyfile {files['broker_key']}", "allow_anonymous false",
                f"password_file {passwords}")  # fmt: skip
    with (
        broker(tmp_path / "broker", address, *settings, port=8883),
        listen(address, "safe/#", *login) as heard,
    ):
        text = SECURE.format(address=address, folder=tmp_path)
        plant = folder.run(folder.write(text, "safe.yaml"))

        def reason() -> str:
            return plant.status()["processes"]["mqtt"].get("bridge", {}).get("reason", "")

        wait_until(lambda: "user 'mixer' or the password is rejected" in reason())
        (tmp_path / "secret").write_text("correct\n")  # read anew for each connection
        wait_until(lambda: heard.payloads("safe/mixer/setpoint"), 40)
        assert heard.payloads("safe/mixer/setpoint")[0]["value"] == 7
        plant.stop()


def test_plant_ends_with_the_status_offline(cell: Cell):
    """The last test of this file: it stops the plant."""
    since = len(cell.heard.messages)
    code, _, err = cell.plant.stop()
    assert code == 0
    assert "Traceback" not in err
    wait_until(lambda: cell.heard.texts("cell/status", since)[-1:] == ["offline"])
    assert [m for m in sparkplug(cell, since) if "/NDEATH/" in m.topic]
