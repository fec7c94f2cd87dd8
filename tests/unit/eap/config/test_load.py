from __future__ import annotations

import re
import shutil
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes, pdo
from eap.codec.amsdiscovery import AMS_UDP_PORT
from eap.codec.amstcp import AMS_TCP_PORT
from eap.codec.ethercat import EAP_PORT
from eap.config.load import INTERFACE_PATH, NET_ID_PATHS, blank
from eap.pd.layout import plan_layout
from eap.pd.spec import PortKind, PortSpec, StationSpec
from eap.runtime.plantfile import load_plant as load_shipped

PLANTS = Path(__file__).parents[4] / "config"


@pytest.fixture(params=sorted(PLANTS.glob("*.yaml")), ids=lambda path: path.name)
def shipped(request):
    result = load_shipped(request.param)
    assert [str(finding) for finding in result.findings] == []
    return result.plant


def test_shipped_plants_have_no_findings_and_a_process_image(shipped):
    for station in shipped.stations:
        assert plan_layout(station).size > 0


def test_a_station_travels_as_json(shipped):
    for station in shipped.stations:
        assert msgspec.json.decode(msgspec.json.encode(station), type=StationSpec) == station


def test_the_demo_is_the_ring_that_the_contract_describes():
    plant = load_shipped(PLANTS / "demo.yaml").plant
    assert [s.name for s in plant.stations] == ["island-01", "island-02", "island-03"]
    assert [s.ports[0].interface for s in plant.stations] == [
        f"udp://127.0.1.{n}" for n in (1, 2, 3)
    ]
    assert "setpoint" in {v.name for v in plant.stations[0].variables if v.writer == "application"}
    assert plant.stations[0].ports[0].join == ("239.88.164.1",)
    for station in plant.stations:
        eap0, bus0 = station.ports
        assert (eap0.name, eap0.kind, bus0.name, bus0.kind) == ("eap0", "eap", "bus0", "bus")
        assert bus0.interface.startswith("sim:///")
    drive = plant.stations[0].ports[1].bus.slaves[0]
    assert (drive.name, drive.station) == ("drive", 1001)


def test_the_solar_line_has_the_sizes_of_the_contract():
    plant = load_shipped(PLANTS / "solar-line.yaml").plant
    sizes = {600: 0, 1024: 0}
    received = 0
    for station in plant.stations:
        assert station.cycle_us == 10_000
        types = {v.name: datatypes.parse(v.type) for v in station.variables}
        for pd in (pd for frame in station.frames for pd in frame.pds):
            sizes[pdo.layout(types[name] for name in pd.variables).size] += 1
        received += len(station.subscriptions)
        assert all(rx.step == 1 for rx in station.subscriptions)
    assert sizes == {600: 26, 1024: 28}
    assert received == 54
    assert [s.name for s in plant.stations] == [f"island-{n:02}" for n in range(1, 15)] + [
        "control"
    ]
    hosts = [s.ports[0].interface.removeprefix("udp://127.0.1.") for s in plant.stations]
    assert hosts == [*map(str, range(1, 15)), "100"]


def test_findings_carry_everything_that_the_contract_names(load_plant):
    [finding] = load_plant(("id: 1,", "id: 70000,")).findings
    assert msgspec.to_builtins(finding) == {
        "file": finding.file,
        "line": 15,
        "path": "stations[0].publish[0].id",
        "message": "id is 70000",
        "expected": "a whole number from 0 to 65535",
    }
    assert Path(finding.file).name == "plant.yaml"


def test_all_findings_come_at_once_in_the_order_of_the_file(load_plant):
    result = load_plant(
        ("count: UDINT", "count: UDIMT"),
        ("to: 127.0.9.2", "to: nowhere"),
        ("net_id: 127.0.9.2.2.1", "net_id: 127.0.9.1.2.1"),
        ("timeout_ms: 50", "timeout_ms: 5"),
    )
    assert result.plant is None
    assert [finding.line for finding in result.findings] == [9, 13, 19, 21]


@pytest.mark.parametrize(
    ("access", "required"),
    [("", False), ("access: {audit: optional}\n", False), ("access: {audit: required}\n", True)],
)
def test_plant_says_whether_the_audit_is_required(load_plant, access, required):
    plant = load_plant(("stations:\n", f"{access}stations:\n")).plant
    assert plant.audit_required is required


WORDS = (PLANTS / "demo.yaml").read_text().split(" ")
ODD = [
    "-1",
    "{}",
    "[]",
    "null",
    "x:",
    "[a]",
    "1e99",
    "udp://x",
    "0.0.0.0",
    "true,",
    "/",
    "&a",
    "*a",
]


@given(
    st.lists(st.tuples(st.integers(0, len(WORDS) - 1), st.sampled_from(ODD + WORDS)), max_size=4)
)
def test_no_content_is_a_traceback(tmp_path_factory, changes):
    words = WORDS.copy()
    for position, word in changes:
        words[position] = word
    folder = tmp_path_factory.getbasetemp()
    if not (folder / "buses").exists():
        shutil.copytree(PLANTS / "buses", folder / "buses")
    path = folder / "odd.yaml"
    path.write_text(" ".join(words))
    result = load_shipped(path)
    assert (result.plant is None) == bool(result.findings)


@pytest.mark.parametrize(
    ("old", "new", "count"),
    [
        ("timeout_ms: 50, substitute", "timeout_sm: 50, substitute", 1),
        ("timeout_ms: 50, substitute", "timeout_ms: 3, substitute", 1),
        ("pieces: {kind: counter}", "pieces: {kind: conuter}", 1),
        ("pieces: {kind: counter}", "peices: {kind: counter}", 1),
    ],
)
def test_fault_in_an_anchor_is_one_finding(tmp_path: Path, old: str, new: str, count: int) -> None:
    text = (PLANTS / "solar-line.yaml").read_text()
    assert text.count(old) == 1
    path = tmp_path / "line.yaml"
    path.write_text(text.replace(old, new))
    findings = load_shipped(path).findings
    assert len(findings) == count, [str(each) for each in findings]
    assert "more places, by an anchor)" in findings[0].message


SECURITY = PLANTS.parent / "docs" / "security.md"


def test_plant_of_the_security_page_has_no_findings(tmp_path):
    (text,) = re.findall(r"^```yaml\n(.*?)^```$", SECURITY.read_text(), re.MULTILINE | re.DOTALL)
    path = tmp_path / "plant.yaml"
    path.write_text(text)
    result = load_shipped(path)
    assert result.findings == result.warnings == ()


def test_security_page_lists_the_ports():
    lines = SECURITY.read_text().splitlines()
    listed = " ".join(line for line in lines if line.startswith("|"))
    for number in (EAP_PORT, EAP_PORT + 1, AMS_TCP_PORT, AMS_UDP_PORT):
        assert str(number) in listed


def test_one_port_and_nothing_else():
    result = blank("mixer", "udp://10.0.0.4", "10.0.0.4.2.1", 5000)
    port = PortSpec("eap0", PortKind.EAP, "udp://10.0.0.4", "10.0.0.4.2.1")
    assert result.findings == ()
    assert result.plant is not None
    assert result.plant.name == "mixer"
    assert result.plant.stations == (StationSpec("mixer", "10.0.0.4.1.1", 5000, (port,)),)


def test_the_router_has_a_net_id_of_its_own():
    result = blank("mixer", "udp://10.0.0.4", "1.2.3.4.0.9", 5000)
    assert result.plant is not None
    assert result.plant.stations[0].net_id == "1.2.3.4.255.9"


@pytest.mark.parametrize(
    ("name", "interface", "net_id", "paths"),
    [
        ("mi/xer", "udp://10.0.0.4", "10.0.0.4.2.1", ["station"]),
        ("mixer", "upd://10.0.0.4", "10.0.0.4.2.1", [INTERFACE_PATH]),
        ("mixer", "sim://bus.yaml", "10.0.0.4.2.1", [INTERFACE_PATH]),
        ("mixer", "udp://239.1.1.1", "10.0.0.4.2.1", [INTERFACE_PATH]),
        ("mixer", "udp://10.0.0.4", "10.0.0.4", [NET_ID_PATHS[1]]),
        ("mixer", "udp://10.0.0.4", "0.0.0.0.0.0", [NET_ID_PATHS[0]]),
        ("mixer", "udp://10.0.0.4", "0.0.0.0.1.0", [NET_ID_PATHS[1]]),
    ],
)
def test_the_rules_of_plant_files_hold(name, interface, net_id, paths):
    result = blank(name, interface, net_id, 5000)
    assert result.plant is None
    assert [finding.path for finding in result.findings] == paths
