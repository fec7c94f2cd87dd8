"""docs/mqtt-values.md: its plant runs, and its commands print what the page prints."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from eap.config.mqtt_sections import MqttBridgeSpec
from eap.runtime.plantfile import load_plant
from tests.support.mosquitto import broker
from tests.support.pages import commands, shell

pytestmark = [pytest.mark.net, pytest.mark.mosquitto]

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "mqtt-values.md").read_text()
PLANT = re.search(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
CONSOLE = "\n".join(re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL))
REFERENCE = (ROOT / "docs" / "plant-file.md").read_text().partition("## Values by MQTT")[2]
ADDRESS = "127.9.74.9"


def outline(text: str) -> list[str]:
    """Return lines without what differs from run to run: numbers, and words that follow them."""
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


def test_mqtt_values_results_of_the_page_are_json():
    (results,) = re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)
    assert [json.loads(line)["ok"] for line in results.splitlines()] == [True, False]


def test_plant_file_page_example_of_mqtt_is_valid(tmp_path):
    (example,) = re.findall(r"```yaml\n(.*?)```", REFERENCE, re.DOTALL)
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
