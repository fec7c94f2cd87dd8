"""``eapctl addresses``."""

from __future__ import annotations

import csv
import json
from io import StringIO
from pathlib import Path

import pytest
from click.testing import CliRunner

from eap.cli.group import main

PLANT = """\
plant: line
s7:
  controllers: {press: 10.0.0.9}
  server: {blocks: {5: [line/on, {of: line/axis.position, write: true}]}}
modbus:
  server: {input: [line/temp]}
types: {Axis: {members: {position: LREAL}}}
stations:
  - name: line
    net_id: 10.0.0.2.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.0.0.1", net_id: 10.0.0.2.2.1}]
    variables:
      temp: {type: REAL, unit: degC, comment: of the oil}
      on: BOOL
      axis: Axis
    sources: {temp: {kind: s7, controller: press, address: DB1.4}}
    targets: {axis.position: {kind: s7, controller: press, address: MD8, type: DINT}}
"""


@pytest.fixture
def plant(tmp_path: Path) -> str:
    path = tmp_path / "plant.yaml"
    path.write_text(PLANT)
    return str(path)


def test_addresses_of_servers_and_controllers_are_listed(plant: str) -> None:
    result = CliRunner().invoke(main, ["addresses", plant, "--json"])
    rows = [json.loads(line) for line in result.stdout.splitlines()]
    assert [(r["at"], r["address"], r["type"], r["variable"], r["access"]) for r in rows] == [
        ("server", "DB5.DBX0.0", "BOOL", "line/on", "read"),
        ("server", "DB5.DBB2", "LREAL", "line/axis.position", "write"),
        ("server", "input:0", "REAL", "line/temp", "read"),
        ("press", "DB1.DBD4", "REAL", "line/temp", "source"),
        ("press", "MD8", "DINT", "line/axis.position", "target"),
    ]
    text = CliRunner().invoke(main, ["addresses", plant]).stdout
    assert "s7      press   DB1.DBD4    REAL   line/temp           from there   degC" in text


def test_csv_has_a_line_of_names(plant: str) -> None:
    result = CliRunner().invoke(main, ["addresses", plant, "--csv"])
    rows = list(csv.DictReader(StringIO(result.stdout)))
    assert rows[2] == {
        "bridge": "modbus", "at": "server", "address": "input:0", "type": "REAL", "bits": "32",
        "variable": "line/temp", "access": "read", "unit": "degC", "comment": "of the oil",
    }  # fmt: skip


def test_plant_without_addresses_and_plant_with_errors(plant: str) -> None:
    text = PLANT[: PLANT.index("s7:")] + "stations:\n" + PLANT.partition("stations:\n")[2]
    text = text[: text.index("    sources")].replace("axis: Axis", "axis: LREAL")
    Path(plant).write_text(text)
    result = CliRunner().invoke(main, ["addresses", plant])
    assert result.stdout == "no variables in data blocks or registers\n"
    Path(plant).write_text(PLANT.replace("DB1.4", "DB1"))
    result = CliRunner().invoke(main, ["addresses", plant])
    assert result.exit_code == 2
    assert "'DB1' is no S7 address" in result.stderr
