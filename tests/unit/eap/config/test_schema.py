"""JSON Schema of plant files, with a validator that is not ours."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from eap.config.document import Node, parse
from eap.config.finding import FindingReport
from eap.config.new_plant import SCHEMA, Shape, plant_text

ROOT = Path(__file__).parents[4]
PLANTS = sorted((ROOT / "config").glob("*.yaml"))
PAIR = re.search(
    r"```yaml\n(plant: pair\n.*?)```", (ROOT / "docs/plant-file.md").read_text(), re.DOTALL
)[1]


@cache
def validator():
    import jsonschema

    schema = json.loads(SCHEMA.read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def data_of(node: Node) -> Any:
    if isinstance(node.value, dict):
        return {key: data_of(each) for key, (_, each) in node.value.items()}
    if isinstance(node.value, list):
        return [data_of(each) for each in node.value]
    return node.value


def errors(text: str) -> list[str]:
    report = FindingReport("plant.yaml")
    root = parse(text, report)
    assert root is not None
    assert report.findings() == ()
    return [each.message for each in validator().iter_errors(data_of(root))]


@pytest.mark.parametrize("plant", PLANTS, ids=lambda path: path.stem)
def test_schema_accepts_plants_of_the_project(plant):
    assert errors(plant.read_text()) == []


@pytest.mark.parametrize("shape", Shape)
def test_schema_accepts_new_plants(shape):
    assert errors(plant_text("hall", 4, shape)) == []


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("to: panel/eap0", "to: 7"),
        ("temperature: {type: REAL, unit: degC}", "temperature: {type: REAL, unit: 1.0}"),
        ("door_open: BOOL", "door_open: {type: BOOL, default: true}"),
        ("    subscribe:\n      - ", "    links:\n    subscribe:\n      - "),
        ("plant: pair", "plant: pair\nx-anything: [1, {a: b}]"),
        ("plant: pair", "plant: pair\nweb: 127.0.0.1:8080"),
        ("from: oven/state", "from: {publisher: 10.0.0.1.2.1, id: 1}"),
        ("net_id: 10.0.0.1.1.1", "net_id: 010.0.0.1.1.1"),
    ],
)
def test_schema_accepts_what_the_loader_takes(old, new):
    assert old in PAIR
    assert errors(PAIR.replace(old, new, 1)) == []


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("cycle_us: 20000", "cyle_us: 20000"),
        ("id: 1,", "id: 65536,"),
        ("id: 1,", "id: one,"),
        ("id: 1,", ""),
        ("kind: eap", "kind: eapp"),
        ("net_id: 10.0.0.1.1.1", "net_id: 10.0.0.1.1"),
        ("net_id: 10.0.0.1.1.1", "net_id: 10.0.0.1.1.256"),
        ("kind: sine", "kind: sinus"),
        ("period_ms: 10000}", "period_ms: 10000, variable: temperature}"),
        ("timeout_ms: 100", "timeout_ms: -1"),
        ("variables: [temperature, door_open]", "variables: temperature"),
        ("plant: pair", "plant: [pair]"),
        ("plant: pair", "plant: pair\nat: here"),
        ("plant: pair", "plant: pair\nwebb: 127.0.0.1:8080"),
        ("door_open: BOOL", "door_open: [BOOL]"),
    ],
)
def test_schema_refuses_typing_errors(old, new):
    assert old in PAIR
    assert errors(PAIR.replace(old, new, 1))


def test_schema_describes_keys_as_the_page_does():
    station = json.loads(SCHEMA.read_text())["$defs"]["StationSection"]["properties"]
    assert station["cycle_us"]["description"] == "device cycle, 100 to 60,000,000"
