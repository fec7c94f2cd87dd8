from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

from eap.codec import datatypes
from eap.config.imports.records import EapImportDevice, ImportReport
from eap.config.imports.treeitems import assemble, read_tree_items
from eap.errors import ConfigError
from eap.ids import NetId
from eap.ops.peers import peer_report, twincat_type, write_peer
from tests.support.pages import ROOT

PLANT = """\
plant: hall
types:
  ST_A: {members: {b: BYTE, r: LREAL}}
stations:
  - name: ours
    net_id: 9.9.9.9.1.1
    ports:
      - {name: eap0, kind: eap, interface: "ethernet://eth0", net_id: 9.9.9.9.2.1, vlan: {id: 7, priority: 2}}
    variables: {a: DINT, b: BOOL8, c: ST_A, d: UINT}
    frames:
      - {name: all, port: eap0, to: "01:01:05:04:00:07", divider: 2}
      - {name: rest, port: eap0, to: multicast}
    publish:
      - {name: a, frame: all, id: 1, version: 3, variables: [a]}
      - {name: two, frame: all, id: 2, variables: [b, d]}
      - {name: c, frame: rest, id: 3, variables: [c], on_change: {}}
    subscribe:
      - {name: plc, port: eap0, from: plc/out}
      - {name: far, port: eap0, from: {publisher: 5.1.2.3.2.1, id: 8}, foreign: true, version: 4, variables: {far: "STRING(81)"}}
  - name: plc
    net_id: 8.8.8.8.1.1
    cycle_us: 2000
    ports:
      - {name: eap0, kind: eap, interface: "ethernet://eth0", net_id: 8.8.8.8.2.1, vlan: {id: 7, priority: 2}, mac: "02:00:00:00:00:08"}
    variables: {out: "REAL[3]", other: INT}
    frames:
      - {name: to-ours, port: eap0, to: multicast, monitor_interval_ms: 0}
    publish:
      - {name: out, frame: to-ours, id: 5, variables: [out]}
      - {name: other, frame: to-ours, id: 6, variables: [other]}
    subscribe:
      - {name: a, port: eap0, from: ours/a, variables: {a: DINT}}
"""  # noqa: E501


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    path = tmp_path / "hall.yaml"
    path.write_text(PLANT)
    return path


def rows(plant: Path) -> list[tuple[object, ...]]:
    _, report = peer_report(plant, "ours")
    return [
        (each.device, each.kind, each.variable, each.id, each.version, each.type, each.bytes,
         each.address, each.period)
        for each in report.rows
    ]  # fmt: skip


def test_table_has_the_other_side_of_everything(plant: Path) -> None:
    assert rows(plant) == [
        ("EAP plc", "publisher", "out", 5, 0, "ARRAY [0..2] OF REAL", 12, "01:01:05:04:00:00",
         "2 ms"),
        ("EAP plc", "subscriber", "a", 1, 3, "DINT", 4, "NetID 9.9.9.9.2.1 01:01:05:04:00:07",
         "20 ms"),
        ("EAP 5.1.2.3.2.1", "publisher", "far", 8, 4, "STRING(80)", 81, "NetID 9.9.9.9.2.1", ""),
        ("EAP other controllers", "subscriber", "c", 3, 0, "ST_A", 16,
         "NetID 9.9.9.9.2.1 01:01:05:04:00:00", "on change"),
    ]  # fmt: skip


def test_pds_of_one_name_and_id_keep_the_periods_of_their_senders(plant: Path) -> None:
    fast = """\
  - name: fast
    net_id: 7.7.7.7.1.1
    cycle_us: 1000
    ports:
      - {name: eap0, kind: eap, interface: "ethernet://eth0", net_id: 7.7.7.7.2.1, vlan: {id: 7}}
    variables: {out: "REAL[3]"}
    frames: [{name: to-ours, port: eap0, to: multicast}]
    publish: [{name: out, frame: to-ours, id: 5, variables: [out]}]
"""
    taken = "      - {name: plc, port: eap0, from: plc/out}\n"
    text = PLANT.replace(taken, taken + "      - {name: fast, port: eap0, from: fast/out}\n")
    plant.write_text(text + fast)
    found = {row[0]: row[-1] for row in rows(plant) if row[2] == "out"}
    assert found == {"EAP plc": "2 ms", "EAP fast": "1 ms"}


def test_publisher_that_answers_polls_is_a_remark() -> None:
    _, report = peer_report(ROOT / "config" / "poll.yaml", "desk")
    assert "answers polls" in " ".join(report.remarks)
    assert all(row.address for row in report.rows)


def test_pd_of_several_variables_is_an_array_with_a_remark(plant: Path) -> None:
    text = PLANT.replace("from: ours/a, variables: {a: DINT}", "from: ours/two")
    plant.write_text(text)
    assert ("EAP plc", "subscriber", "two", 2, 0, "ARRAY [0..2] OF BYTE", 3,
            "NetID 9.9.9.9.2.1 01:01:05:04:00:07", "20 ms") in rows(plant)  # fmt: skip
    _, report = peer_report(plant, "ours")
    assert report.remarks == ("PD 2 (two) carries b BOOL, d UINT: a struct with pack_mode 1",)


def read(*texts: str) -> tuple[EapImportDevice, ...]:
    report = ImportReport()
    found = assemble(
        [each for text in texts for each in read_tree_items([text.encode()], "", report)], report
    )
    assert not report.findings
    return tuple(
        replace(
            each,
            line=0,
            boxes=tuple(
                replace(box, line=0, variables=tuple(replace(var, line=0) for var in box.variables))
                for box in each.boxes
            ),
        )
        for each in found
    )


def test_export_is_read_again_with_the_same_settings(plant: Path, tmp_path: Path) -> None:
    devices, report = peer_report(plant, "ours")
    (box, *_) = devices[0].boxes
    assert (box.vlan_id, box.vlan_priority, box.is_monitored) == (7, 2, False)
    assert devices[1].boxes[0].net_id == NetId.parse("9.9.9.9.2.1")
    file = tmp_path / "peer.xml"
    written = write_peer(devices, report, file, force=False)
    assert written.files == (str(file),)
    again = read(file.read_text())
    # The cycle of one device stands for all that have none.
    assert [replace(each, cycle_us=0) for each in again] == [
        replace(each, cycle_us=0) for each in devices
    ]
    folder = tmp_path / "items"
    folder.mkdir()
    files = write_peer(devices, report, folder, force=False).files
    assert len(files) == 3 + sum(1 + 2 * len(box.variables) for d in devices for box in d.boxes)
    assert read(*(Path(each).read_text() for each in files)) == again


def test_existing_files_are_kept_unless_forced(plant: Path, tmp_path: Path) -> None:
    devices, report = peer_report(plant, "ours")
    file = tmp_path / "peer.xml"
    file.write_text("mine")
    with pytest.raises(ConfigError, match="exists: overwrite it with --force"):
        write_peer(devices, report, file, force=False)
    assert file.read_text() == "mine"
    write_peer(devices, report, file, force=True)
    assert file.read_text().startswith("<?xml")


def test_unknown_station_is_named(plant: Path) -> None:
    with pytest.raises(ConfigError, match="unknown station 'our', did you mean ours"):
        peer_report(plant, "our")


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("BOOL", "BOOL"),
        ("BOOL8", "BOOL"),
        ("STRING(81)", "STRING(80)"),
        ("WSTRING(10)", "WSTRING(10)"),
        ("BLOCK(6)", "ARRAY [0..5] OF BYTE"),
        ("BLOCK(1)", "BYTE"),
        ("BIT3", "BYTE"),
        ("UINT24", "ARRAY [0..2] OF BYTE"),
        ("LTIME", "LTIME"),
        ("REAL[4]", "ARRAY [0..3] OF REAL"),
        ("INT[1..3,2]", "ARRAY [1..3,0..1] OF INT"),
        ("STRING(11)[2]", "ARRAY [0..1] OF STRING(10)"),
        ("E_M<INT:Off=0>", "E_M"),
        ("ST_A<16/8:b@0 BYTE,r@8 LREAL>[2]", "ARRAY [0..1] OF ST_A"),
        ("T_Name<STRING(21)>", "T_Name"),
    ],
)
def test_types_have_twincats_names(kind: str, expected: str) -> None:
    assert twincat_type(datatypes.parse(kind)) == expected
