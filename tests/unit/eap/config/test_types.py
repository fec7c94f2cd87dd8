from __future__ import annotations

from pathlib import Path

import pytest

from eap.config.load import PlantResult, load
from eap.config.types import type_text
from eap.pd.spec import Writer

HEAD = """\
plant: axes
types:
{types}
stations:
  - name: left
    net_id: 127.0.9.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.0.9.1", net_id: 127.0.9.1.2.1}}
    variables:
      axis: {axis}
      copy: {axis}
      speed: LREAL
      flag: BOOL
{more}
"""
TYPES = """\
  ST_Axis:
    members: {position: LREAL, state: E_State, enable: BOOL, jog: T_Speed, table: "ST_Point[2]"}
  E_State: {base: USINT, values: {Off: 0, On: 1}}
  T_Speed: "INT (-100..100)"
  ST_Point: {pack: 1, members: {x: BYTE, y: REAL}}
"""
FULL = (
    "ST_Axis<24/8:position@0 LREAL,state@8 E_State<USINT:Off=0,On=1>,enable@9 BOOL,"
    "jog@10 T_Speed<INT(-100..100)>,table@12 ST_Point<5/1:x@0 BYTE,y@1 REAL>[2]>"
)
# As TwinCAT 3 writes it: the size of members is in bits, BOOL has 8, a text one byte more.
TMC = """\
<TcModuleClass><DataTypes>
<DataType><Name GUID="{11111111-0000-4000-8000-000000000001}">ST_A</Name><BitSize>192</BitSize>
<SubItem><Name>b</Name><Type>BOOL</Type><BitSize>8</BitSize><BitOffs>0</BitOffs></SubItem>
<SubItem><Name>r</Name><Type>LREAL</Type><BitSize>64</BitSize><BitOffs>64</BitOffs></SubItem>
<SubItem><Name>s</Name><Type>STRING(5)</Type><BitSize>48</BitSize><BitOffs>128</BitOffs></SubItem>
<SubItem><Name>m</Name><Type>E_M</Type><BitSize>16</BitSize><BitOffs>176</BitOffs></SubItem></DataType>
<DataType><Name>E_M</Name><BitSize>16</BitSize><BaseType>INT</BaseType>
<EnumInfo><Text>Off</Text><Enum>0</Enum></EnumInfo><EnumInfo><Text>On</Text><Enum>1</Enum></EnumInfo></DataType>
<DataType><Name>ST_Wrong</Name><BitSize>128</BitSize>
<SubItem><Name>b</Name><Type>BYTE</Type><BitSize>8</BitSize><BitOffs>0</BitOffs></SubItem>
<SubItem><Name>r</Name><Type>LREAL</Type><BitSize>32</BitSize><BitOffs>64</BitOffs></SubItem></DataType>
<DataType><Name>FB_X</Name><BitSize>64</BitSize>
<SubItem><Name>p</Name><Type PointerTo="1">INT</Type><BitSize>64</BitSize><BitOffs>0</BitOffs></SubItem></DataType>
<DataType><Name>ST_Grown</Name><BitSize>256</BitSize><ExtendsType>ST_A</ExtendsType>
<SubItem><Name>w</Name><Type>WORD</Type><ArrayInfo><LBound>1</LBound><Elements>2</Elements></ArrayInfo>
<BitSize>32</BitSize><BitOffs>192</BitOffs></SubItem></DataType>
<DataType><Name>ARRAY [1..3] OF ST_A</Name><BitSize>576</BitSize><BaseType>ST_A</BaseType>
<ArrayInfo><LBound>1</LBound><Elements>3</Elements></ArrayInfo></DataType>
</DataTypes></TcModuleClass>
"""  # noqa: E501


def loaded(folder: Path, types: str = TYPES, axis: str = "ST_Axis", more: str = "") -> PlantResult:
    file = folder / "plant.yaml"
    file.write_text(HEAD.format(types=types.rstrip(), axis=axis, more=more))
    (folder / "axis.tmc").write_text(TMC)
    return load(file, lambda *_: pytest.fail("no bus"))


def findings(folder: Path, **parts: str) -> list[str]:
    result = loaded(folder, **parts)
    return [
        f"{Path(each.file).name}:{each.line}: {each.message}; {each.expected}"
        for each in result.findings
    ]


def test_variable_has_the_complete_text_of_its_type(tmp_path):
    result = loaded(tmp_path)
    assert not result.findings
    (station,) = result.plant.stations
    assert station.variables[0].type == FULL
    assert [kind.name for kind in result.types.resolved()] == [
        "E_State", "T_Speed", "ST_Point", "ST_Axis",
    ]  # fmt: skip


def test_types_are_found_in_whatever_case_and_in_arrays(tmp_path):
    (station,) = loaded(tmp_path, axis="'array [1..2] of st_point'").plant.stations
    assert station.variables[0].type == "ST_Point<5/1:x@0 BYTE,y@1 REAL>[1..2]"


def test_types_of_a_file_are_laid_out_as_it_says(tmp_path):
    types = "  - axis.tmc\n  - {ST_B: {members: {a: 'ST_Grown[2]'}}}"
    (station,) = loaded(tmp_path, types, "ST_B").plant.stations
    own = "ST_A<24/8:b@0 BOOL,r@8 LREAL,s@16 STRING(6),m@22 E_M<INT:Off=0,On=1>>"
    members = own.removeprefix("ST_A<24/8:").removesuffix(">")
    assert (
        station.variables[0].type == f"ST_B<64/8:a@0 ST_Grown<32/8:{members},w@24 WORD[1..2]>[2]>"
    )


def test_types_of_one_name_in_a_file_are_a_finding_when_one_is_used(tmp_path, monkeypatch):
    second = TMC[TMC.index("<DataType>") : TMC.index("</DataType>")].replace("BYTE", "WORD")
    name = second[second.index("<Name") :].partition(">")[2].partition("<")[0]
    twice = TMC.replace("</DataTypes>", f"{second}<SubItem><Name>more</Name><Type>INT</Type>"
        "<BitSize>16</BitSize><BitOffs>800</BitOffs></SubItem></DataType></DataTypes>")  # fmt: skip
    monkeypatch.setattr(f"{__name__}.TMC", twice)
    types = "  - axis.tmc\n  - {ST_Own: {members: {a: INT}}}"
    assert not findings(tmp_path, types=types, axis="ST_Own")
    (finding,) = findings(tmp_path, types=types, axis=name)
    assert f"type {name} is defined twice (first in" in finding


def test_type_of_a_file_that_nothing_uses_is_no_finding(tmp_path):
    # Files of controllers have function blocks too.
    assert not findings(tmp_path, types="  - axis.tmc", axis="ST_A")


def test_size_that_contradicts_the_file_is_shown_beside_ours(tmp_path):
    (found,) = findings(tmp_path, types="  - axis.tmc", axis="ST_Wrong")
    what, *table = found.splitlines()
    assert what == ("axis.tmc:9: r of ST_Wrong has 4 bytes there, as LREAL 8 bytes; one size:")
    assert [line.split() for line in table] == [
        ["given", "computed"],
        ["b", "at", "0", "size", "1", "at", "0", "size", "1", "BYTE"],
        ["r", "at", "8", "size", "4", "at", "8", "size", "8", "LREAL", "differs"],
        ["(all)", "size", "16", "size", "16"],
    ]


def test_type_of_two_files_is_ambiguous_only_where_it_is_used(tmp_path):
    other = TMC.replace("<BitSize>192</BitSize>", "<BitSize>256</BitSize>")
    (tmp_path / "other.tmc").write_text(other)
    types = "  - axis.tmc\n  - other.tmc"
    assert not findings(tmp_path, types=types, axis="E_M")  # which both define alike
    (found,) = findings(tmp_path, types=types, axis="ST_A")
    assert found.startswith("other.tmc:2: type ST_A is defined twice (first in ")


def test_pointer_is_refused_where_the_type_is_used(tmp_path):
    (found,) = findings(tmp_path, types="  - axis.tmc", axis="FB_X")
    assert found == ("axis.tmc:13: p of FB_X is a pointer; a value, a pointer is none elsewhere")


@pytest.mark.parametrize(
    ("types", "finding"),
    [
        (
            "  A: {members: {b: B}}\n  B: {members: {c: 'C[2]'}}\n  C: A",
            "plant.yaml:3: types contain themselves: A → B → C → A; one of them without the next",
        ),
        ("  A: {members: {a: A}}", "3: types contain themselves: A → A"),
        ("  A: {members: {a: Bee}}\n  Be: INT", "3: a of A: 'Bee' is not a data type, did you"),
        ("  A: {members: {a: INT}, values: {b: 1}}", "3: type A has values and members; one of al"),
        ("  A: {pack: 4}", "3: type A defines nothing; one of alias, values, members, union"),
        ("  A: {members: [x, y]}", "3: members is a list; a mapping from names"),
        ("  A: {members: {x: INT, X: INT}}", "3: A has members x and X; names that differ in more"),
        ("  A: {members: {x: 'INT[3..1]'}}", "3: x of A: 'INT[3..1]' has no elements; a number of"),
        ("  A: {pack: 3, members: {a: INT}}", "3: pack is 3; one of 1, 2, 4, 8"),
        ("  UINT: INT", "3: 'UINT' is no name of a type of its own"),
        ("  'A B': INT", "3: 'A B' is no name of a type of its own; letters, digits and _"),
        ("  A: INT\n  a: UINT", "4: type a is defined twice (first in line 3); each name once"),
        ("  A: {values: {x: 40000}}", "3: x of A: 40000 is not a value of INT; a whole number"),
        ("  A: {base: REAL, values: {x: 1}}", "3: A has the base REAL; a whole number such as INT"),
        ("  A: {members: {x: 'BYTE[70000]'}}", "3: x of A: 'BYTE[70000]' has 70000 bytes"),
        (
            "  A: {members: {x: 'BYTE[60000]', y: 'BYTE[60000]'}}",
            "3: 'A' has 120000 bytes; 1 to 65535",
        ),
        (
            "  A: {members: {x: {type: INT, offset: 1}, y: INT}}",
            "3: A has an offset for some members; it for all",
        ),
        (
            "  A: {members: {x: {type: INT, offset: 0}, y: {type: INT, offset: 1}}}",
            "3: y of A lies on x; members behind each other",
        ),
        ("  A: {extends: E_X, members: {x: INT}}\n  E_X: INT", "3: A extends E_X; a struct"),
        ("  - none.tmc", "3: none.tmc: No such file or directory; a TMC or TPY file"),
        ("  - [A]", "3: item 1 of types is a list; a mapping from names"),
        ("  5", "2: types is 5; a mapping or a list"),
        (
            "  A: {size: 8, members: {x: INT}}",
            "3: A has 8 bytes there, 2 bytes by its members; one size:",
        ),
        (
            "  A: {size: 8, extends: B}\n  B: {members: {x: INT}}",
            "3: A has 8 bytes there, 2 bytes by its members; one size:",
        ),
        ("\n".join(f"  A{n}: {{members: {{x: A{n + 1}}}}}" for n in range(20)) + "\n  A20: INT",
         "A0 is nested too deeply; at most 16 levels"),
    ],
)  # fmt: skip
def test_wrong_definition_has_one_finding(tmp_path, types, finding):
    found = findings(tmp_path, types=types, axis="INT")
    assert len(found) == 1, found
    assert finding in found[0]


def test_all_wrong_types_are_found_at_once(tmp_path):
    types = "  A: {members: {x: Q}}\n  B: {members: {y: R, a: A}}\n  C: {values: {z: 99999}}"
    found = findings(tmp_path, types=types, axis="S")
    assert [each.split(";")[0] for each in found] == [
        "plant.yaml:3: x of A: 'Q' is not a data type (such as UINT, REAL[4] or STRING(16))",
        "plant.yaml:4: y of B: 'R' is not a data type (such as UINT, REAL[4] or STRING(16))",
        "plant.yaml:5: z of C: 99999 is not a value of INT",
        "plant.yaml:12: axis: 'S' is not a data type (such as UINT, REAL[4] or STRING(16))",
        "plant.yaml:13: copy: 'S' is not a data type (such as UINT, REAL[4] or STRING(16))",
    ]


def test_all_wrong_members_of_a_type_are_found_at_once(tmp_path):
    types = "  A: {members: {x: FLOAT, y: INT, z: STRING}}"
    found = [each.split(",")[0] for each in findings(tmp_path, types=types, axis="A")]
    assert found == [
        "plant.yaml:3: x of A: 'FLOAT' is not a data type",
        "plant.yaml:3: z of A: 'STRING' lacks its length in bytes",
    ]


@pytest.mark.parametrize("types", ["  A: {members: [x]}", "  A: {pack: 4}"])
def test_variable_of_a_type_that_defines_nothing_has_no_finding(tmp_path, types):
    assert len(findings(tmp_path, types=types, axis="A")) == 1


def test_struct_of_too_many_levels_is_named_without_its_text(tmp_path):
    types = "\n".join(f"  D{n}: {{members: {{x: D{n - 1}}}}}" for n in range(1, 20))
    found = findings(tmp_path, types=f"  D0: {{members: {{x: INT}}}}\n{types}", axis="INT")
    assert [each.partition(": ")[2] for each in found] == [
        "D16 is nested too deeply; 16 levels at most"
    ]


@pytest.mark.parametrize(
    ("member", "ways"),
    [
        ("S", "bits: 16"),
        ("T", "bits: 32"),
        ("BYTE[8]", "bits: 64 or swap"),
        ("INT", "bits: 16 or scale"),
    ],
)
def test_link_of_other_types_names_the_ways_that_are_possible(tmp_path, member, ways):
    types = f"  S: {{members: {{a: INT}}}}\n  T: TIME\n  A: {{members: {{m: '{member}'}}}}"
    more = "    links: [{from: axis.m, to: speed}]"
    found = findings(tmp_path, types=types, axis="A", more=more)
    assert [each.partition("both alike, or ")[2] for each in found] == [ways]


def test_variable_of_a_wrong_type_has_no_finding_of_its_own(tmp_path):
    types = "  ST_Axis: {members: {x: Q}}"
    links = "    links: [{from: axis.x, to: speed}]"
    found = findings(tmp_path, types=types, more=links)
    assert len(found) == 1
    assert "x of ST_Axis: 'Q'" in found[0]


def test_links_and_sources_take_members(tmp_path):
    more = """\
    sources:
      axis.position: {kind: sine, amplitude: 5, period_ms: 1000}
      "axis.table[1].x": {kind: counter}
    links:
      - {from: axis.position, to: copy.position}
      - {from: copy.position, to: speed}
      - {from: flag, to: copy.enable}
      - {from: axis.enable, to: flag, bits: 1}
      - {from: "axis.table[0]", to: "copy.table[1]"}
      - {from: axis.jog, to: copy.jog}
"""
    result = loaded(tmp_path, more=more)
    assert not result.findings
    (station,) = result.plant.stations
    assert {v.name: v.writer for v in station.variables} == {
        "axis": Writer.ENGINE,
        "copy": Writer.ENGINE,
        "speed": Writer.ENGINE,
        "flag": Writer.ENGINE,
    }
    # Each behind those that write what it reads.
    order = [link.target for link in station.links]
    assert order.index("copy.position") < order.index("speed")
    assert order.index("flag") < order.index("copy.enable")


@pytest.mark.parametrize(
    ("more", "finding"),
    [
        ("links: [{from: axis.positon, to: speed}]", "station left has no 'axis.positon': ST_Axis"),
        (
            "links: [{from: axs.position, to: speed}]",
            "left has no variable 'axs.position', did you",
        ),
        ("links: [{from: speed, to: axis.jog}]", "speed is LREAL, axis.jog is T_Speed; both alike"),
        ("links: [{from: 'axis.table[2].y', to: speed}]", "ST_Point[2] has no element 2: 0 to 1"),
        (
            "links: [{from: speed, to: axis.position}, {from: copy, to: axis}]",
            "'axis' is linked twice",
        ),
        (
            "links: [{from: axis.position, to: copy.position}, {from: copy, to: axis}]",
            "links form a loop: axis.position → copy.position → axis",
        ),
        ("sources: {axis.state: {kind: counter}}", "axis.state is E_State, this source makes num"),
        ("sources: {axis.jog: {kind: ramp, low: 0, high: 200, period_ms: 9}}", "beyond T_Speed"),
        (
            "sources: {axis.jog: {kind: counter}, axis: {kind: random}}",
            "'axis' has two sources (the other, 'axis.jog', in line 18)",
        ),
        (
            "sources: {axis.jog: {kind: counter}, axis.position: {kind: host, measure: load1}}",
            "'axis' has sources of two kinds",
        ),
        (
            "sources: {axis.jog: {kind: counter}}\n    links: [{from: copy.jog, to: axis.jog}]",
            "'axis.jog' has a source (line 18), so no link can write it",
        ),
        ("sources: {axis.x: {kind: counter}}", "left has no 'axis.x': ST_Axis has no member 'x'"),
    ],
)
def test_wrong_member_has_a_finding(tmp_path, more, finding):
    found = findings(tmp_path, more=f"    {more}")
    assert len(found) == 1, found
    assert finding in found[0]


def test_variable_with_the_name_of_a_member_is_refused(tmp_path):
    loaded(tmp_path)
    file = tmp_path / "plant.yaml"
    more = "flag: BOOL\n      axis.jog: INT\n      axis.other: INT"
    file.write_text(file.read_text().replace("flag: BOOL", more))
    (found,) = load(file, lambda *_: pytest.fail("no bus")).findings
    assert found.message == "variable 'axis.jog' has the name of a member of 'axis'"
    assert found.line == 18


def test_default_of_a_struct_names_some_members(tmp_path):
    axis = "{type: ST_Axis, default: {state: On, table: [{x: 1, y: 2.5}, {x: 2, y: 3.5}]}}"
    (station,) = loaded(tmp_path, axis=axis).plant.stations
    assert station.variables[0].default == {
        "position": 0.0,
        "state": "On",
        "enable": False,
        "jog": 0,
        "table": [{"x": 1, "y": 2.5}, {"x": 2, "y": 3.5}],
    }


@pytest.mark.parametrize(
    ("default", "finding"),
    [
        ("{sate: On}", "default of axis: ST_Axis has no member 'sate', did you mean state?"),
        (
            "{state: Up}",
            "default of axis: state of ST_Axis: 'Up' is not a value of E_State; Off (0)",
        ),
        ("{jog: 101}", "default of axis: jog of ST_Axis: 101 is not a value of T_Speed; a whole"),
        ("5", "default of axis: 5 is not a value of ST_Axis; members such as {position: …}"),
        ("[1]", "default of axis: [1] is not a value of ST_Axis"),
    ],
)
def test_wrong_default_of_a_struct(tmp_path, default, finding):
    found = findings(tmp_path, axis=f"{{type: ST_Axis, default: {default}}}")
    assert len(found) == 2  # of axis and copy
    assert finding in found[0]


@pytest.mark.parametrize(
    ("text", "ours"),
    [
        ("STRING(80)", "STRING(81)"),
        ("STRING", "STRING(81)"),
        ("string[10]", "STRING(11)"),
        ("WSTRING(7)", "WSTRING(7)"),
        ("ARRAY [0..3] OF STRING(9)", "ARRAY [0..3] OF STRING(10)"),
        ("DWORD (1..86400)", "DWORD (1..86400)"),
        ("DWORD (0..GVL.N)", "DWORD"),
        ("AMSNETID", "USINT[6]"),
        ("ST_STRINGS", "ST_STRINGS"),
    ],
)
def test_types_of_twincat_in_our_terms(text, ours):
    assert type_text(text) == ours
