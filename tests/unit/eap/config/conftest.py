from __future__ import annotations

import pytest

from eap.config.bus import describe_buses
from eap.config.document import convert, read
from eap.config.finding import FindingReport, PlantFinding
from eap.config.index import DescribedPdoEntry, DescribedSlave, ExpectedBus, Index
from eap.config.load import load

PLANT = """\
plant: pair
stations:
  - name: left
    net_id: 127.0.9.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.0.9.1", net_id: 127.0.9.1.2.1}
    variables:
      speed: {type: REAL, unit: 1/min, default: 2.5}
      count: UDINT
    sources:
      count: {kind: counter}
    frames:
      - {name: out, port: eap0, to: 127.0.9.2}
    publish:
      - {name: state, frame: out, id: 1, version: 3, variables: [speed, count]}
  - name: right
    net_id: 127.0.9.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.0.9.2", net_id: 127.0.9.2.2.1}
    subscribe:
      - {name: seen, port: eap0, from: left/state, timeout_ms: 50, variables: {a: REAL, b: UDINT}}
"""

BUS = ExpectedBus(
    (
        DescribedSlave(
            name="valves",
            vendor=1,
            product=2,
            outputs=(
                DescribedPdoEntry("valve", "BOOL", 0x7000, 1, 1),
                DescribedPdoEntry("lamp", "BOOL", 0x7000, 2, 1),
                DescribedPdoEntry("", "", 0, 0, 6),
                DescribedPdoEntry("speed", "INT", 0x7000, 3, 16),
            ),
            inputs=(
                DescribedPdoEntry("limit", "BOOL", 0x6000, 1, 1),
                DescribedPdoEntry("", "", 0, 0, 7),
                DescribedPdoEntry("status word", "UINT", 0x6000, 2, 16),
            ),
        ),
    )
)
"""Content of line.yaml in the tests."""


def describe(path):
    """Stand for the reader of bus files, which belongs to the appliance."""
    if "broken" in path.name:
        return (PlantFinding(str(path), 3, "slaves[0]", "kind is 'x'", "one of a, b"),)
    return BUS


def edited(*edits):
    text = PLANT
    for old, new in edits:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


@pytest.fixture
def load_plant(tmp_path):
    """Load the two stations above after some edits, (old, new) each."""

    def load_edited(*edits):
        path = tmp_path / "plant.yaml"
        path.write_text(edited(*edits))
        for name in ("line.yaml", "broken.yaml"):
            (tmp_path / name).touch()
        return load(path, describe)

    return load_edited


@pytest.fixture
def findings(load_plant):
    """Return what is wrong after some edits, as ``line: message; expected``."""

    def of(*edits):
        result = load_plant(*edits)
        assert (result.plant is None) == bool(result.findings)
        return [f"{f.line}: {f.message}; {f.expected}" for f in result.findings]

    return of


@pytest.fixture
def index(tmp_path):
    """Index the two stations above after some edits; nothing is checked."""

    def of(*edits):
        path = tmp_path / "plant.yaml"
        path.write_text(edited(*edits))
        report = FindingReport(str(path))
        plant = convert(read(path, report), report)
        (tmp_path / "line.yaml").touch()
        return Index(plant, describe_buses(plant, tmp_path, describe, report))

    return of
