"""``eapctl od`` on a station."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from eap.control.protocol import ErrorCode
from eap.errors import ControlError
from eap.od.model import OdState
from tests.support.controlstub import ControlStub
from tests.support.oddevice import MemoryDevice, methods, mixer


@pytest.fixture
def device():
    return MemoryDevice(mixer())


@pytest.fixture
def stub(device, runtime):
    ports = [{"name": "eap0", "kind": "eap"}, {"name": "bus0", "kind": "bus"}]
    status = {"stations": [{"name": "mixer", "ports": ports}]}
    far = methods(device) | {"status": lambda _: status, "ams_ask": ams_ask}
    with ExitStack() as stack:
        yield ControlStub("line", ["mixer"], far, stack)


def ams_ask(params):
    """Answer for a master whose dictionary has one entry, and for nobody else."""
    if params["target"] not in {"mixer/bus0", "5.1.1.9.3.1:1001"}:
        reason = "no station 'mixr' in this plant, did you mean mixer?"
        raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
    if params["command"] == 4:
        return {"error": 0, "data": "0000000005000800"}
    is_known = params["data"].startswith("02f30000 00000010".replace(" ", ""))
    data = "00000000 04000000 01020304" if is_known else "02070000 00000000"
    return {"error": 0, "data": data.replace(" ", "")}


@pytest.fixture
def command(stub):
    return lambda *words: CliRunner().invoke(main, ["od", *words])


def test_list(command, stub):
    lines = command("list", "mixer").output.splitlines()
    assert any(line.split() == ["0xD000", "TxPD", "0", "RECORD", "7"] for line in lines)
    rows = [
        json.loads(line) for line in command("list", "mixer/eap0", "--json").output.splitlines()
    ]
    assert rows[0] == {
        "index": 0x1000,
        "name": "Device type",
        "label": "",
        "code": "VAR",
        "max_subindex": 0,
    }
    asked = {params["target"] for method, params in stub.requests if method != "status"}
    assert asked == {"mixer", "mixer/eap0"}


@pytest.mark.parametrize(
    ("entry", "line"),
    [
        ("0x1000", "0x1000:00 = UDINT 65541001  # Device type, 0x3E81389"),
        ("1008", '0x1008:00 = STRING(32) "mixer #1"  # Device name'),
        ("0xD000:07", "0xD000:07 = UDINT 10000  # Cycle time, us, 0x2710"),
        ("0xD000:7", "0xD000:07 = UDINT 10000  # Cycle time, us, 0x2710"),
        ("0x6000:8", "0x6000:08 = BOOL true  # Default given"),
        ("0x8000:10", "0x8000:10 = UINT 0xD000  # TxPD 1, 0xD000"),
        ("8000:0x10", "0x8000:10 = UINT 0xD000  # TxPD 1, 0xD000"),
        ("0x8000:3", "0x8000:03 = BLOCK(6) 01:01:05:04:00:00  # Destination MAC"),
        ("0x8000:4", "0x8000:04 = BLOCK(6) 127.0.1.2.2.1  # Destination NetID"),
        ("0x8000:5", "0x8000:05 = BLOCK(4) 127.0.1.2  # Destination IP"),
    ],
)
def test_read(command, entry, line):
    assert command("read", "mixer", entry).output == f"{line}\n"


def test_read_as_json(command):
    assert json.loads(command("read", "mixer", "0xD000:7", "--json").output) == {
        "index": 0xD000,
        "subindex": 7,
        "complete": False,
        "name": "Cycle time",
        "access": "rw",
        "type": "UDINT",
        "unit": "us",
        "value": 10000,
        "data": "10270000",
    }


def test_read_by_another_type(command):
    line = "0xD000:07 = UINT[2] 10000,0  # Cycle time, us\n"
    assert command("read", "mixer", "0xD000:7", "--type", "UINT[2]").output == line
    line = "0xD000:07 = hex 10270000  # Cycle time, us\n"
    assert command("read", "mixer", "0xD000:7", "--type", "ULINT").output == line


def test_whole_objects(command):
    assert command("read", "mixer", "0x1A00", "--complete").output.splitlines() == [
        "# 0x1A00 TxPDO mapping 0",
        "0x1A00:00 = USINT 1  # SubIndex 000",
        "0x1A00:01 = UDINT 0x6000:01/32  # Mapping 1, 0x60000120",
    ]
    row = json.loads(command("read", "mixer", "0xD000:1", "--complete", "--json").output)
    assert (row["data"], row["complete"]) == ("10270000", True)
    assert [entry["value"] for entry in row["entries"]] == [10000]


@pytest.mark.parametrize(
    ("entry", "value", "octets"),
    [
        ("0xD000:7", "0x4E20", "204e0000"),
        ("0x6000:5", "left speed", b"left speed".hex()),
        ("0x6000:9", "-1.5e3", "0080bbc4"),
        ("0x6000:8", "off", "00"),
        ("0x8000:3", "01:02:03:04:05:06", "010203040506"),
        ("0x8000:5", "10.0.0.1", "0a000001"),
    ],
)
def test_write(command, device, entry, value, octets):
    result = command("write", "mixer", entry, value)
    assert result.exit_code == 0, result.stderr
    assert device.written[-1][2].hex() == octets


def test_written_entry_is_printed(command):
    assert command("write", "mixer", "0xD000:7", "20000").output == (
        "0xD000:07 = UDINT 20000  # Cycle time, us, 0x4E20\n"
    )
    row = json.loads(command("write", "mixer", "0xD000:7", "--hex", "10270000", "--json").output)
    assert row == {"index": 0xD000, "subindex": 7, "complete": False, "data": "10270000"}


def test_write_of_octets(command, device):
    assert command("write", "mixer", "0xD000:7", "--hex", "01000000").output == (
        "0xD000:07 = hex 01000000\n"
    )
    command("write", "mixer", "0xD000:1", "--complete", "--hex", "02000000")
    assert device.written == [(0xD000, 7, b"\1\0\0\0"), (0xD000, 1, b"\2\0\0\0")]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("write", "mixer"), "nothing to write"),
        (("write", "mixer", "0xD000:7"), "expected one value: VALUE or --hex DIGITS"),
        (
            ("write", "mixer", "0xD000:7", "1", "--hex", "01"),
            "expected one value: VALUE or --hex DIGITS",
        ),
        (("write", "mixer", "0xD000:1", "1", "--complete"), "--complete writes raw bytes"),
        (("write", "mixer", "0xD000:x", "1"), "such as 0x1018:01"),
        (("write", "mixer", "1", "--from", "x"), "omit all other arguments"),
        (("read", "mixer//eap0", "1"), "is not STATION, STATION/PORT, STATION/PORT/SLAVE"),
        (("write", "mixer", "0xD000:7", "fast"), "0xD000:07: 'fast' is not a value of UDINT"),
    ],
)
def test_usage(command, words, reason):
    result = command(*words)
    assert result.exit_code == 2
    assert reason in result.stderr


def test_aborts_are_said_in_words(command, device):
    result = command("write", "mixer", "0xD005:7", "1")
    assert (result.exit_code, result.stderr) == (
        1,
        "0xD005:00: object does not exist (0x06020000)\n",
    )
    assert "subindex does not exist" in command("write", "mixer", "0xD000:63", "1").stderr
    result = command("read", "mixer", "0xD000:9")
    assert (result.exit_code, result.stderr) == (
        1,
        "0xD000:09: subindex does not exist (0x06090011)\n",
    )
    device.state = OdState.OP
    result = command("write", "mixer", "0xD000:7", "1")
    assert result.exit_code == 1
    assert "in this device state (0x08000022)" in result.stderr


def test_station_that_does_not_run(command):
    result = command("read", "mixr", "0x1000")
    assert result.exit_code == 1
    assert "did you mean mixer?" in result.stderr


@pytest.mark.parametrize("target", ["mixer/bus0", "5.1.1.9.3.1:1001"])
def test_masters_and_what_is_behind_routes(command, stub, target):
    assert json.loads(command("read", target, "0x1000", "--json").output)["data"] == "01020304"
    assert stub.requests[-1][1]["device"] is True
    refused = command("read", target, "0x1001")
    assert refused.exit_code == 1
    assert (
        f"{target}: 0x1001:00: the device has no object dictionary (error 0x702)" in refused.stderr
    )


def test_dump_prints_text_lines(command):
    lines = command("dump", "mixer").output.splitlines()
    assert lines[0] == (
        "# The objects of mixer.  'eapctl od write TARGET --from FILE' writes them to another"
    )
    start = lines.index('# 0x6000 Tx variable 0 (speed "set" # 1)')
    assert lines[start - 1 : start + 7] == [
        "",
        '# 0x6000 Tx variable 0 (speed "set" # 1)',
        "# 0x6000:00 = USINT 9  # SubIndex 000",
        "# 0x6000:01 = REAL 1.5  # Value",
        '0x6000:04 = STRING(40) "REAL"  # Type name',
        '0x6000:05 = STRING(255) "speed \\"set\\" # 1"  # Name',
        "0x6000:08 = BOOL true  # Default given",
        "0x6000:09 = REAL 0.25  # Default",
    ]
    assert "# 0x8000:06: cannot be read  # Key" in lines


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_a_dump_can_be_written_again(command, device, tmp_path, options):
    path = tmp_path / "mixer.od"
    path.write_text(command("dump", "mixer", *options).output)
    result = command("write", "mixer", "--from", str(path))
    assert result.output == "mixer: 0 entries written, 13 were there already\n"
    fresh = mixer()
    blank = [(0xD000, 7), (0x6000, 5), (0x8000, 3), (0x1A00, 1)]
    for index, subindex in blank:
        entry = device.dictionary[index].entries[subindex]
        entry.octets = bytes(entry.kind.size)
    row = json.loads(command("write", "mixer", "--from", str(path), "--json").output)
    assert row == {"target": "mixer", "written": 12, "unchanged": 1}
    for index, subindex in blank:
        assert device.dictionary[index].entries[subindex].octets == (
            fresh[index].entries[subindex].octets
        )


def test_slaves(bus_appliance):
    def command(*words):
        return CliRunner().invoke(main, ["od", *words]).output

    target = "press/bus0/sensor"
    assert command("read", target, "0x1018:1") == "0x1018:01 = UDINT 3674  # Vendor ID, 0xE5A\n"
    assert command("write", target, "0x8000:1", "6") == "0x8000:01 = UDINT 6  # Filter\n"
    assert "\n0x8001  Calibration" in command("list", target)
    assert "0x8000:01 = UDINT 6  # Filter\n" in command("dump", target)
