"""Structs of running stations by ADS, with pyads and ads-client: whole, by members, watched."""

from __future__ import annotations

import ctypes
import json
import subprocess
from typing import Any

import pytest

from eap.codec.ads import AdsError
from eap.codec.adssymbol import DataTypeEntry, DataTypeFlag, UploadInfo
from tests.support.adslib import open_connection
from tests.support.adstypes import decode_types
from tests.support.appliance import Appliance, Plants, run_eapctl, wait_until
from tests.support.npm import needs_npm, node_environment

pyads = pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = pytest.mark.net

ADDRESS, OTHER = "127.9.76.1", "127.9.76.2"
PORT = f"{ADDRESS}.2.1"
DEVICE = 0xFFFF
MEMBERS = """\
      flag: BOOL
      byte: BYTE
      word: WORD
      dword: DWORD
      lword: LWORD
      sint: SINT
      int: INT
      dint: DINT
      lint: LINT
      usint: USINT
      uint: UINT
      udint: UDINT
      ulint: ULINT
      real: REAL
      flag2: BOOL
      lreal: LREAL
      time: TIME
      ltime: LTIME
      date: DATE
      tod: TOD
      dt: DT
      ldate: LDATE
      ltod: LTOD
      ldt: LDT
      text: STRING(13)
      wide: WSTRING(7)
      char: WCHAR
      flags: "BOOL[3]"
      texts: "STRING(5)[2]"
      grid: "ARRAY [1..3, 0..1] OF REAL"
      state: E_State
      states: "E_State[2]"
      speed: T_Speed
      limit: DINT (-1000..1000)
      inner: ST_Inner
      inners: "ST_Inner[1..2]"
      rows: "ARRAY [0..1] OF ARRAY [0..2] OF INT"
      bits: ST_Bits
      either: U_Either
      end: USINT
"""
TYPES = "".join(
    f"  ST_Forty{pack}:\n    pack: {pack}\n    members:\n{MEMBERS}" for pack in (1, 2, 4, 8)
)
PLANT = f"""\
plant: structs
defaults: {{cycle_us: 2000}}
types:
  E_State: {{base: INT, values: {{Off: 0, On: 1, Fault: -2}}}}
  T_Speed: INT
  ST_Inner: {{members: {{a: BYTE, b: LREAL, c: "INT[3]"}}}}
  ST_Bits: {{members: {{ready: BIT, alarm: {{type: BIT}}, count: USINT}}}}
  U_Either: {{union: {{real: LREAL, words: "WORD[4]"}}}}
  ST_Packed:
    pack: 1
    members: {{on: BOOL, value: LREAL, name: STRING(21), wide: WSTRING(5), list: "INT[3]"}}
{TYPES}stations:
  - name: tower
    net_id: {ADDRESS}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{ADDRESS}", net_id: {PORT}}}
    variables:
      axis1: ST_Forty1
      axis2: ST_Forty2
      axis4: ST_Forty4
      axis8: ST_Forty8
      packed: {{type: ST_Packed, default: {{name: left}}}}
      table: "ST_Inner[3]"
      ramp: ST_Inner
    sources:
      ramp.b: {{kind: ramp, low: 0, high: 1000, period_ms: 60000}}
    frames: [{{name: out, port: eap0, to: panel/eap0}}]
    publish: [{{name: state, frame: out, id: 1, variables: [axis1, axis8, packed]}}]
  - name: panel
    net_id: {OTHER}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{OTHER}", net_id: {OTHER}.2.1}}
    subscribe: [{{name: in, port: eap0, from: tower/state}}]
"""
VALUES: dict[str, Any] = {
    "flag": True, "byte": 1, "word": 2, "dword": 3, "lword": 1 << 60, "sint": -1, "int": -2,
    "dint": -3, "lint": -(1 << 60), "usint": 7, "uint": 8, "udint": 9, "ulint": 1 << 62,
    "real": 1.5, "flag2": True, "lreal": 0.1, "time": 1500, "ltime": 5000, "date": 86400,
    "tod": 3_600_000, "dt": 1_800_000_000, "ldate": 86_400_000_000_000, "ltod": 17,
    "ldt": 1_800_000_000_000_000_000, "text": "größe", "wide": "Łódź €", "char": 0x20AC,
    "flags": [True, False, True], "texts": ["ab", "cd"],
    "grid": [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], "state": 1, "states": [-2, 0], "speed": 500,
    "limit": -1000, "inner": {"a": 1, "b": 2.5, "c": [1, -2, 3]},
    "inners": [{"a": 2, "b": -1.0, "c": [4, 5, 6]}, {"a": 3, "b": 0.5, "c": [7, 8, 9]}],
    "rows": [[1, 2, 3], [4, 5, 6]], "bits": {"ready": True, "alarm": False, "count": 3},
    "either": {"real": 1.0, "words": [0, 0, 0, 0x3FF0]}, "end": 255,
}  # fmt: skip
SHOWN = VALUES | {
    "time": "T#1s500ms", "ltime": "LTIME#5us", "date": "D#1970-01-02", "tod": "TOD#01:00:00",
    "dt": "DT#2027-01-15-08:00:00", "ldate": "LDATE#1970-01-02", "ltod": "LTOD#00:00:00.000000017",
    "ldt": "LDT#2027-01-15-08:00:00", "char": "€", "state": "On", "states": ["Fault", "Off"],
    "bits": {"ready": 1, "alarm": 0, "count": 3},
}  # fmt: skip


@pytest.fixture(scope="module")
def appliance(module_farm: Plants) -> Appliance:
    return module_farm.run(module_farm.write(PLANT))


@pytest.fixture(scope="module")
def tower(appliance: Appliance) -> pyads.Connection:
    del appliance
    return open_connection(PORT, DEVICE, ADDRESS)


@pytest.fixture(scope="module")
def types(tower: pyads.Connection) -> dict[str, DataTypeEntry]:
    info = UploadInfo.decode(bytes(tower.read(0xF00F, 0, ctypes.c_uint8 * 24)))
    found = decode_types(bytes(tower.read(0xF00E, 0, ctypes.c_uint8 * info.type_size)))
    assert len(found) == info.types
    return found


def received(appliance: Appliance, name: str) -> Any:
    """Return what the other station has received."""
    return appliance.values("panel")[f"in.{name}"]


NUMBERS = {
    "BOOL": pyads.PLCTYPE_BOOL, "BYTE": pyads.PLCTYPE_BYTE, "WORD": pyads.PLCTYPE_WORD,
    "DWORD": pyads.PLCTYPE_DWORD, "LWORD": pyads.PLCTYPE_ULINT, "SINT": pyads.PLCTYPE_SINT,
    "INT": pyads.PLCTYPE_INT, "DINT": pyads.PLCTYPE_DINT, "LINT": pyads.PLCTYPE_LINT,
    "USINT": pyads.PLCTYPE_USINT, "UINT": pyads.PLCTYPE_UINT, "UDINT": pyads.PLCTYPE_UDINT,
    "ULINT": pyads.PLCTYPE_ULINT, "REAL": pyads.PLCTYPE_REAL, "LREAL": pyads.PLCTYPE_LREAL,
}  # fmt: skip


LEAVES: dict[str, Any] = {
    name: value
    for name, value in VALUES.items()
    if not isinstance(value, dict | list) or name == "flags"
} | {
    "texts[0]": "ab", "texts[1]": "cd", "states[0]": -2, "states[1]": 0,
    **{f"grid[{row},{column}]": 2.0 * row + column - 1 for row in (1, 2, 3) for column in (0, 1)},
    "inner.a": 1, "inner.b": 2.5, "inner.c": [1, -2, 3],
    "inners[1].a": 2, "inners[1].b": -1.0, "inners[1].c": [4, 5, 6],
    "inners[2].a": 3, "inners[2].b": 0.5, "inners[2].c[0]": 7, "inners[2].c[1]": 8,
    "inners[2].c[2]": 9, "rows[0]": [1, 2, 3], "rows[1]": [4, 5, 6],
    "bits.ready": True, "bits.alarm": False, "bits.count": 3, "either.words[3]": 0x3FF0,
}  # fmt: skip
KINDS = {
    "bits.ready": pyads.PLCTYPE_BOOL, "bits.alarm": pyads.PLCTYPE_BOOL,
    "char": pyads.PLCTYPE_UINT, "state": pyads.PLCTYPE_INT, "states": pyads.PLCTYPE_INT,
    "speed": pyads.PLCTYPE_INT,
} | dict.fromkeys(("lword", "ltime", "ldate", "ltod", "ldt"), pyads.PLCTYPE_ULINT)  # fmt: skip
"""Types that pyads does not know by their names."""


def definition(types: dict[str, DataTypeEntry], name: str) -> tuple[Any, ...]:
    """Return pyads' definition of a struct, with its padding, from the uploaded types."""
    rows: list[Any] = []
    end = 0
    for item in types[name].items:
        if item.offset > end:
            rows.append((f"pad{end}", pyads.PLCTYPE_USINT, item.offset - end))
        end = item.offset + item.size
        count, base = 1, types[item.type_name]
        while base.type_name or base.dimensions:
            for each in base.dimensions:
                count *= each.elements
            base = types[base.type_name]
        if base.name.startswith(("STRING(", "WSTRING(")):
            kind = pyads.PLCTYPE_WSTRING if base.name[0] == "W" else pyads.PLCTYPE_STRING
            rows.append((item.name, kind, count, int(base.name.partition("(")[2][:-1])))
        elif base.name in NUMBERS:
            rows.append((item.name, NUMBERS[base.name], count))
        else:
            rows.append((item.name, pyads.PLCTYPE_USINT, item.size))
    if types[name].size > end:
        rows.append(("pad", pyads.PLCTYPE_USINT, types[name].size - end))
    return tuple(rows)


def test_pyads_reads_and_writes_packed_struct(appliance, tower, types) -> None:
    packed = (
        ("on", pyads.PLCTYPE_BOOL, 1),
        ("value", pyads.PLCTYPE_LREAL, 1),
        ("name", pyads.PLCTYPE_STRING, 1, 20),
        ("wide", pyads.PLCTYPE_WSTRING, 1, 5),
        ("list", pyads.PLCTYPE_INT, 3),
    )
    assert definition(types, "ST_Packed") == packed
    assert tower.read_structure_by_name("packed", packed)["name"] == "left"
    wanted = {"on": True, "value": 2.5, "name": "right", "wide": "Łódź", "list": [1, -2, 3]}
    tower.write_structure_by_name("packed", wanted, packed)
    assert dict(tower.read_structure_by_name("packed", packed)) == wanted
    assert appliance.values("tower")["packed"] == wanted
    wait_until(lambda: received(appliance, "packed") == wanted)
    symbol = tower.get_symbol("packed", structure_def=packed)
    assert symbol.read()["list"] == [1, -2, 3]
    assert tower.read_list_by_name(["packed.value", "PACKED.LIST[1]", "packed.name"]) == {
        "packed.value": 2.5, "PACKED.LIST[1]": -2, "packed.name": "right",
    }  # fmt: skip
    tower.write_list_by_name({"packed.value": 4.5, "packed.list[2]": 7})
    assert appliance.values("tower")["packed"] == wanted | {"value": 4.5, "list": [1, -2, 7]}


@pytest.mark.parametrize("pack", [1, 2, 4, 8])
def test_pyads_reads_and_writes_forty_members(appliance, tower, types, pack: int) -> None:
    axis, described = f"axis{pack}", types[f"ST_Forty{pack}"]
    forty = definition(types, f"ST_Forty{pack}")
    assert len(described.items) == len(VALUES) == 40
    assert pyads.size_of_structure(forty) == described.size
    assert any(name.startswith("pad") for name, *_ in forty) is (pack > 1)
    octets = ctypes.c_uint8 * described.size
    tower.write_by_name(axis, [0] * described.size, octets)
    for path, value in LEAVES.items():
        kind = KINDS.get(path.partition("[")[0])  # else pyads finds it by the name of the type
        tower.write_by_name(f"{axis}.{path}", value, kind)
        assert tower.read_by_name(f"{axis}.{path}", kind) == value
    assert appliance.values("tower")[axis] == SHOWN
    if pack in {1, 8}:
        wait_until(lambda: received(appliance, axis) == SHOWN)
    read = tower.read_structure_by_name(axis, forty)
    simple = [name for name in VALUES if name in LEAVES] + ["texts", "states"]
    assert len(simple) == 34
    assert {name: read[name] for name in simple} == {name: VALUES[name] for name in simple}
    before = tower.read_by_name(axis, octets)
    changed = {"dint": 77, "text": "plain"}  # pyads pads a text by its characters, not its bytes
    tower.write_structure_by_name(axis, read | changed, forty)
    assert appliance.values("tower")[axis] == SHOWN | changed
    for name in changed:
        tower.write_by_name(f"{axis}.{name}", VALUES[name])
    assert tower.read_by_name(axis, octets) == before


def test_pyads_lists_variables_and_takes_arrays_of_structs(appliance, tower, types) -> None:
    symbols = {symbol.name: symbol for symbol in tower.get_all_symbols()}
    assert symbols["axis8"].symbol_type == "ST_Forty8"
    assert symbols["table"].symbol_type == "ARRAY [0..2] OF ST_Inner"
    assert not any("." in name for name in symbols if name.startswith(("axis", "table")))
    inner = definition(types, "ST_Inner")
    rows = tower.read_structure_by_name("table", inner, array_size=3)
    for n, row in enumerate(rows):
        row.update(a=n, b=n / 2, c=[n, -n, 0])
    tower.write_structure_by_name("table", rows, inner, array_size=3)
    expected = [{"a": n, "b": n / 2, "c": [n, -n, 0]} for n in range(3)]
    assert appliance.values("tower")["table"] == expected
    tower.write_by_name("table[1].c[2]", 99)
    expected[1]["c"] = [1, -1, 99]
    assert appliance.values("tower")["table"] == expected


def test_members_of_sources_and_hostile_names_are_refused(tower) -> None:
    def refusal(name: str) -> int:
        with pytest.raises(pyads.ADSError) as refused:
            tower.write_by_name(name, 1.0, pyads.PLCTYPE_LREAL)
        return int(refused.value.err_code)

    assert refusal("ramp.b") == AdsError.ACCESS
    for name in (
        "axis8[99999999999]",
        "table[3].b",
        "axis8" + ".inner" * 50,
        "axis8.inner.",
        "x.b",
    ):
        assert refusal(name) == AdsError.SYMBOL_NOT_FOUND


def test_member_is_notified_when_it_changes(tower) -> None:
    told: list[float] = []
    quiet: list[int] = []

    def take(kind: type, values: list[Any]) -> Any:
        def callback(notification: object, _: object) -> None:
            values.append(tower.parse_notification(notification, kind)[2])

        return callback

    tower.write_by_name("table[2].b", 0.5)
    wanted = pyads.NotificationAttrib(8)
    handles = tower.add_device_notification("table[2].b", wanted, take(pyads.PLCTYPE_LREAL, told))
    others = tower.add_device_notification(
        "table[2].a", pyads.NotificationAttrib(1), take(pyads.PLCTYPE_BYTE, quiet)
    )
    symbol = tower.get_symbol("table[1].b", auto_update=True)
    try:
        wait_until(lambda: told and quiet)
        tower.write_by_name("table[2].b", 1.5)
        tower.write_by_name("table[1].b", 2.5)
        wait_until(lambda: told[-1] == 1.5 and symbol.value == 2.5)
        assert told == [0.5, 1.5]
        assert len(quiet) == 1
    finally:
        symbol.auto_update = False
        tower.del_device_notification(*handles)
        tower.del_device_notification(*others)


LONG = ["lword", "lint", "ulint", "ltime", "ldate", "ltod", "ldt"]
CLIENT = """
const { Client } = require("ads-client");
const [netId, port, address, given, long] = process.argv.slice(1);
const client = new Client({
  targetAmsNetId: netId, targetAdsPort: Number(port), localAmsNetId: "192.168.5.5.1.1",
  localAdsPort: 40001, routerAddress: address, rawClient: true, autoReconnect: false,
  convertDatesToJavascript: false,
});
(async () => {
  await client.connect();
  const values = JSON.parse(given);
  const symbols = await client.getSymbols();
  const types = await client.getDataTypes(false);
  for (const name of JSON.parse(long)) values[name] = BigInt(values[name]);
  const empty = await client.getDefaultPlcObject("ST_Forty8");
  const read = [];
  for (const pack of [1, 2, 4, 8]) {
    await client.writeValue(`axis${pack}`, empty);
    read.push((await client.readValue(`axis${pack}`)).value);
    await client.writeValue(`axis${pack}`, values);
    read.push((await client.readValue(`axis${pack}`)).value);
  }
  await client.writeValue("axis8.inners[2]", { b: 8.5 }, true);
  await client.writeValue("AXIS8.BITS.ALARM", true);
  const member = (await client.readValue("axis8.inners[2].b")).value;
  const alarm = (await client.readValue("axis8.bits.alarm")).value;
  const text = (await client.readValue("axis8.wide")).value;
  const told = [];
  const subscription = await client.subscribeValue("axis8.grid[3,1]", (data) => {
    told.push(data.value);
    if (told.length == 1) client.writeValue("axis8.grid[3,1]", 12.5);
  }, 20);
  while (told.length < 2) await new Promise((resolve) => setTimeout(resolve, 10));
  await subscription.unsubscribe();
  const seen = {
    symbols: Object.values(symbols).map((each) => [each.name, each.type]),
    types: Object.fromEntries(Object.values(types).map((each) => [each.name, each.size])),
    full: (await client.getDataTypes(true))["st_forty8"].subItems.length,
    state: (await client.getDataType("E_State")).enumInfos.map((each) => [each.name, each.value]),
    empty, read, member, alarm, text, told,
  };
  console.log(JSON.stringify(seen, plain));
  await client.disconnect();
})().catch((error) => { console.error(error); process.exit(1); });
function plain(_, value) { return typeof value == "bigint" ? String(value) : value; }
"""


@needs_npm("ads-client")
def test_ads_client_reads_and_writes_structs_as_objects(appliance, types) -> None:
    given = VALUES | {name: str(VALUES[name]) for name in LONG}  # JavaScript's BigInt
    words = [
        "node",
        "-e",
        CLIENT,
        "--",
        PORT,
        str(DEVICE),
        ADDRESS,
        json.dumps(given),
        json.dumps(LONG),
    ]
    done = subprocess.run(
        words,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env=node_environment(),
    )
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert ["axis8", "ST_Forty8"] in seen["symbols"]
    sizes = {each.name: each.size for each in types.values()}
    assert {name: seen["types"][name] for name in sizes} == sizes
    assert seen["full"] == 40
    assert seen["state"] == [["Off", 0], ["On", 1], ["Fault", -2]]
    off, on, fault = ({"name": name, "value": value} for name, value in seen["state"])
    filled = given | {"state": on, "states": [fault, off]}
    assert seen["read"] == [seen["empty"], filled] * 4
    assert (seen["member"], seen["alarm"], seen["text"]) == (8.5, True, VALUES["wide"])
    assert seen["told"] == [6.0, 12.5]
    inners = [VALUES["inners"][0], VALUES["inners"][1] | {"b": 8.5}]
    shown = SHOWN | {
        "grid": [[1.0, 2.0], [3.0, 4.0], [5.0, 12.5]],
        "inners": inners,
        "bits": {"ready": 1, "alarm": 1, "count": 3},
    }
    values = appliance.values("tower")
    assert [values[f"axis{pack}"] for pack in (1, 2, 4, 8)] == [SHOWN, SHOWN, SHOWN, shown]


def test_changed_type_is_a_new_version_of_the_symbols(appliance, tower, types, tmp_path) -> None:
    before = tower.read(0xF008, 0, pyads.PLCTYPE_BYTE)
    changed = tmp_path / "changed.yaml"
    changed.write_text(PLANT.replace('{a: BYTE, b: LREAL, c: "INT[3]"}', "{b: LREAL, a: BYTE}"))
    done = run_eapctl(appliance.runtime, "apply", str(changed))
    assert done.returncode == 0, done.stdout + done.stderr
    wait_until(lambda: tower.read(0xF008, 0, pyads.PLCTYPE_BYTE) != before)
    info = UploadInfo.decode(bytes(tower.read(0xF00F, 0, ctypes.c_uint8 * 24)))
    after = decode_types(bytes(tower.read(0xF00E, 0, ctypes.c_uint8 * info.type_size)))
    assert [each.name for each in after["ST_Inner"].items] == ["b", "a"]
    assert after["ST_Inner"].hash != types["ST_Inner"].hash
    assert after["ST_Forty8"].hash != types["ST_Forty8"].hash
    assert after["ST_Packed"] == types["ST_Packed"]
    assert after["ST_Packed"].flags == DataTypeFlag.DATA_TYPE
    assert tower.read_by_name("table[0].b") == 0.0
