"""docs/mqtt-values.md: its plant runs, and its commands print what the page prints."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from eap.config.bridge_sections import MqttBridgeSpec
from eap.runtime.plantfile import load_plant
from tests.support.eventually import wait_until
from tests.support.mosquitto import broker
from tests.support.mqttlisten import listen, publish
from tests.support.pages import commands, shell

pytestmark = [pytest.mark.net, pytest.mark.mosquitto]

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "mqtt-values.md").read_text()
PLANT = re.search(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
CONSOLE = "\n".join(re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL))
REFERENCE = (ROOT / "docs" / "plant-file.md").read_text().partition("## Values by MQTT")[2]
SECTION = REFERENCE.partition("\n## ")[0]
ADDRESS = "127.9.74.9"


def outline(text: str) -> list[str]:
    """Return lines without what differs from run to run: numbers, and words that follow them."""
    text = text.replace("engine (Python)", "engine")  # without the compiled part
    lines = re.sub(r"[0-9.]+( %| MB)?", "N", text).splitlines()
    return [re.sub(r"[\s─]+", " ", line).strip() for line in lines if line.strip()]


def test_mqtt_values_page_examples_run(tmp_path):
    assert PLANT is not None
    (settings,) = re.findall(r"```text\n(listener .*?)```", PAGE, re.DOTALL)
    first, *lines = settings.splitlines()
    assert first == f"listener 1883 {ADDRESS}"
    with broker(tmp_path, ADDRESS, *lines), shell() as here:
        (here.folder / "cell.yaml").write_text(PLANT[1])
        done = 0
        for command, expected in commands(CONSOLE):
            if command.startswith("mosquitto -c"):
                continue  # it runs already
            assert outline(here.run(command)) == outline(expected), command
            done += 1
        assert done == 6


def test_mqtt_values_page_bridge_joins_two_brokers(tmp_path):
    """Values and births go out, commands come in; only address and login are replaced."""
    (block,) = re.findall(r"```text\n(connection .*?)```", PAGE, re.DOTALL)
    private = ("bridge_cafile", "remote_username", "remote_password")
    lines = [line for line in block.splitlines() if not line.startswith(private)]
    outer = "127.9.74.10"
    lines[1] = f"address {outer}:1883"
    values = {"cell/mixer/turns": b"1", "spBv1.0/works/NBIRTH/cell": b"2",
              "spBv1.0/works/DDATA/cell/mixer": b"3"}  # fmt: skip
    commands_in = {"cell/mixer/setpoint/set": b"4", "spBv1.0/works/NCMD/cell": b"5",
                   "spBv1.0/works/DCMD/cell/mixer": b"6"}  # fmt: skip
    with (
        broker(tmp_path / "outer", outer),
        listen(outer) as outside,
        broker(tmp_path / "inner", ADDRESS, "allow_anonymous true", *lines),
        listen(ADDRESS) as inside,
    ):
        # Told to the outer broker, and to the inner one, which passes it on: once or twice.
        wait_until(lambda: outside.texts("cell/bridge")[-1:] == ["1"])
        for heard, address, sent in ((outside, ADDRESS, values), (inside, outer, commands_in)):
            for topic, payload in sent.items():
                publish(address, topic, payload)
            for topic, payload in sent.items():
                wait_until(lambda h=heard, t=topic, p=payload: h.texts(t) == [p.decode()])
        publish(outer, "cell/mixer/turns", b"7")
        publish(outer, "cell/mixer/setpoint/set", b"8")
        wait_until(lambda: inside.texts("cell/mixer/setpoint/set") == ["4", "8"])
        assert inside.texts("cell/mixer/turns") == ["1"]  # values do not come in


def test_mqtt_values_results_of_the_page_are_json():
    (results,) = re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)
    assert [json.loads(line)["ok"] for line in results.splitlines()] == [True, False]


def test_plant_file_page_example_of_mqtt_is_valid(tmp_path):
    (example,) = re.findall(r"```yaml\n(.*?)```", SECTION, re.DOTALL)
    for name in ("secrets/mqtt", "certificates/works.pem"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text("x\n")
    stations = "".join(
        f"  - name: {name}\n    net_id: 5.1.1.{number}.1.1\n"
        f"    ports: [{{name: eap0, kind: eap, interface: 'udp://127.0.9.{number}',"
        f" net_id: 5.1.1.{number}.2.1}}]\n    variables: {{speed: REAL, setpoint: INT}}\n"
        for number, name in enumerate(("mixer", "mill"), 1)
    )
    file = tmp_path / "plant.yaml"
    file.write_text(f"plant: works\nstations:\n{stations}{example}")
    result = load_plant(file)
    assert result.plant is not None, result.findings
    spec = result.plant.bridges["mqtt"]
    assert isinstance(spec, MqttBridgeSpec)
    assert spec.broker.port == 8883
