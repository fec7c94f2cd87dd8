from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from eap.cli.group import main

PLANT = """\
plant: axes
types:
  - axis.tmc
  - E_State: {values: {Off: 0, On: 1}}
    T_State: E_State
    ST_Axis: {members: {flag: BIT, state: T_State, position: LREAL, on: BOOL}}
    U_Any: {union: {r: REAL, w: "WORD[2]"}}
stations:
  - name: mixer
    net_id: 1.1.1.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.0.9.1", net_id: 1.1.1.1.2.1}
"""
TMC = """\
<TcModuleClass><DataTypes><DataType><Name>ST_File</Name><BitSize>16</BitSize>
<SubItem><Name>b</Name><Type>BYTE</Type><BitSize>8</BitSize><BitOffs>0</BitOffs></SubItem></DataType>
<DataType><Name>ST_Bad</Name><BitSize>16</BitSize>
<SubItem><Name>b</Name><Type>REAL</Type><BitSize>16</BitSize><BitOffs>0</BitOffs></SubItem></DataType>
</DataTypes></TcModuleClass>
"""


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    path = tmp_path / "plant.yaml"
    path.write_text(PLANT)
    (tmp_path / "axis.tmc").write_text(TMC)
    return path


def run(*words: object) -> Result:
    return CliRunner().invoke(main, ["types", *map(str, words)])


def test_types_of_a_plant_have_their_layout_with_padding(plant: Path) -> None:
    lines = [" ".join(line.split()) for line in run(plant).stdout.splitlines()]
    at = lines.index("ST_Axis struct of 4 members, 24 bytes, aligned to 8")
    assert lines[at + 3 : at + 11] == [
        "0 1 bit flag BIT1",
        "0.1 15 bits (padding)",
        "2 2 state T_State",
        "4 4 (padding)",
        "8 8 position LREAL",
        "16 1 on BOOL",
        "17 7 (padding)",
        "",
    ]
    assert "T_State another name of E_State, 2 bytes, aligned to 2" in lines
    assert "U_Any union of 2 members, 4 bytes, aligned to 4" in lines
    at = lines.index("E_State enum of 2 values, 2 bytes, aligned to 2")
    assert lines[at + 1 : at + 3] == ["Off = 0", "On = 1"]
    # No variable uses it.
    assert not any("ST_File" in line for line in lines)


def test_type_of_a_file_is_shown_by_name_as_json(plant: Path) -> None:
    (line,) = run(plant, "st_file", "--json").stdout.splitlines()
    assert json.loads(line) == {
        "name": "ST_File",
        "kind": "struct",
        "size": 2,
        "alignment": 1,
        "text": "ST_File<2/1:b@0 BYTE>",
        "layout": [
            {"name": "b", "type": "BYTE", "bit_offset": 0, "bits": 8},
            {"name": "", "type": "", "bit_offset": 8, "bits": 8},
        ],
        "values": {},
        "of": "",
    }


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["Qqqq"], "no type 'Qqqq'; types: "),
        (["ST_Axs"], "no type 'ST_Axs', did you mean ST_Axis?"),
        (
            ["ST_Bad"],
            "axis.tmc:3: b of ST_Bad has 2 bytes there, as REAL 4 bytes; expected one size:",
        ),
    ],
)
def test_type_that_cannot_be_shown(plant: Path, words: list[str], reason: str) -> None:
    result = run(plant, *words)
    assert result.exit_code == 2
    assert reason in result.stderr


def test_plant_with_errors_is_not_shown(plant: Path) -> None:
    plant.write_text(PLANT.replace("position: LREAL", "position: LREEL"))
    result = run(plant)
    assert result.exit_code == 2
    assert "position of ST_Axis: 'LREEL' is not a data type, did you mean LREAL?" in result.stderr


def test_plant_without_types(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    head, _, rest = PLANT.partition("types:")
    path.write_text(f"{head}stations:{rest.partition('stations:')[2]}")
    assert run(path).stdout == "no types of its own\n"
