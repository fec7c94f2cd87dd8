"""Warnings about plant files that are well."""

from __future__ import annotations

from pathlib import Path

import pytest

from eap.ops.check import check_file, check_plant

PLANTS = sorted((Path(__file__).parents[4] / "config").glob("*.yaml"))
PLANT = """\
plant: line
stations:
  - name: mixer
    net_id: 1.1.1.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.0.9.1", net_id: 1.1.1.1.2.1}}
      - {{name: eap1, kind: eap, interface: "udp://127.0.9.2", net_id: 1.1.1.1.3.1}}
  - name: oven
    net_id: 1.1.1.2.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.0.9.3", net_id: 1.1.1.2.2.1}}
    variables: {{speed: BIT1, {name}: INT}}
    frames:
      - {{name: out, port: eap0, to: 239.1.2.3}}
    publish:
      - {{name: state, frame: out, id: 7, variables: [{variables}]}}
"""


def write(folder: Path, name: str = "level", count: int = 1) -> Path:
    path = folder / "plant.yaml"
    path.write_text(PLANT.format(name=name, variables=", ".join(["speed"] * count)))
    return path


@pytest.mark.parametrize("count", [1, 248])
def test_plant_within_the_dictionary_has_no_warning(tmp_path: Path, count: int) -> None:
    report, _ = check_plant(write(tmp_path, count=count))
    assert (report.findings, report.warnings) == ((), ())


@pytest.mark.parametrize(
    ("more", "reason"), [({"count": 255}, "PD state"), ({"name": "n" * 256}, "255 bytes")]
)
def test_dictionary_overflow_is_a_warning_with_line(
    tmp_path: Path, more: dict, reason: str
) -> None:
    path = write(tmp_path, **more)
    report, plant = check_plant(path)
    (warning,) = report.warnings
    assert plant
    assert (warning.file, warning.line, warning.path) == (str(path), 8, "stations[1]")
    assert warning.message.startswith("station oven, port eap0: 0x")
    assert "does not fit into the dictionary" in warning.message
    assert reason in warning.message


def test_a_file_that_is_no_plant_has_findings_only(tmp_path: Path) -> None:
    report, plant = check_plant(write(tmp_path, name="a b"))
    assert report.findings
    assert (report.warnings, plant) == ((), None)


BUS_PLANT = """\
plant: line
stations:
  - name: mixer
    net_id: 1.1.1.1.1.1
    ports:
      - {name: bus0, kind: bus, interface: "sim://bus.yaml", net_id: 1.1.1.1.3.1}
"""
BUS = """\
bus: b
slaves:
  - {name: in, kind: digital, inputs: [{name: a}]}
  - {name: in2, kind: digital, inputs: [{name: b}]}
  - {name: out, kind: digital, outputs: [{name: c}]}
"""


def test_check_warns_of_slaves_of_one_product_with_other_process_data(tmp_path: Path) -> None:
    (tmp_path / "plant.yaml").write_text(BUS_PLANT)
    (tmp_path / "bus.yaml").write_text(BUS)
    report, _ = check_plant(tmp_path / "plant.yaml")
    (warning,) = report.warnings
    assert (report.findings, warning.line) == ((), 3)
    assert warning.message.startswith("station mixer, port bus0: in and out have the same vendor")
    (tmp_path / "bus.yaml").write_text(BUS.replace("out, kind", "out, product: 7, kind"))
    assert check_plant(tmp_path / "plant.yaml")[0].warnings == ()


READ_ONLY = """\
bus: b
slaves:
  - name: sensor
    kind: analogue
    inputs: [{name: level, type: INT}]
    objects: [{index: 0x8001, name: Serial, type: UDINT, access: ro}]
    master: {startup: [{sdo: "0x8001", value: 5}]}
"""


def test_check_warns_of_a_start_up_write_to_a_read_only_object(tmp_path: Path) -> None:
    (tmp_path / "plant.yaml").write_text(BUS_PLANT)
    (tmp_path / "bus.yaml").write_text(READ_ONLY)
    message = (
        f"{tmp_path}/bus.yaml:7: 0x8001:00 of sensor is read-only by its description; expected an"
        " object that can be written, otherwise the slave may stay in PREOP"
    )
    for name in ("plant.yaml", "bus.yaml"):
        report = check_file(tmp_path / name).report
        assert (report.ok, [str(each) for each in report.warnings]) == (True, [message])
    # The same key of the plant file has its line there.
    bus, _, write = READ_ONLY.partition("    master: ")
    (tmp_path / "bus.yaml").write_text(bus)
    slaves = f"slaves: {{sensor: {write.strip()}}}"
    (tmp_path / "plant.yaml").write_text(BUS_PLANT.replace("3.1}", f"3.1, {slaves}}}"))
    (warning,) = check_file(tmp_path / "plant.yaml").report.warnings
    assert (warning.file, warning.line) == (str(tmp_path / "plant.yaml"), 6)


@pytest.mark.parametrize("plant", PLANTS, ids=lambda path: path.stem)
def test_check_has_no_warning_for_our_own_plants(plant: Path) -> None:
    assert check_plant(plant)[0].warnings == ()
