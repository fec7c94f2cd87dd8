"""``eapctl bus``: scan, state, diag, sii and voe."""

from __future__ import annotations

import json

import pytest

from eap.cli.group import main
from tests.support.loopbus import LoopBus

WHERE = ["--interface", "udp://127.0.4.1"]


@pytest.fixture
def line(monkeypatch):
    found = LoopBus("coe")
    found.replace(monkeypatch)
    return found


@pytest.fixture
def command(capsys):
    """Run one command; return its exit code, stdout and stderr."""

    def run(*words):
        with pytest.raises(SystemExit) as end:
            main(["bus", *words], prog_name="eapctl")
        return end.value.code, *capsys.readouterr()

    return run


def document(command, *words):
    code, out, err = command(*words, *WHERE, "--json")
    assert (code, err) == (0, "")
    return json.loads(out)


def test_scan(line, command):
    rows = document(command, "scan")["slaves"]
    assert [row["name"] for row in rows] == ["coupler", "buttons", "sensor"]
    code, out, _ = command("scan", *WHERE)
    assert code == 0
    assert "0xBBC3052" in out


def test_state(line, command):
    assert "INIT" in command("state", *WHERE)[1]
    (row,) = document(command, "state", "sensor", "preop")["slaves"]
    assert row["state"] == "PREOP"
    assert {row["state"] for row in document(command, "state", "OP")["slaves"]} == {"OP"}


def test_unknown_state_is_refused(line, command):
    code, _, err = command("state", "sensor", "RUN", *WHERE)
    assert code == 2
    assert "'RUN' is not a state; expected one of INIT, PREOP" in err


def test_state_that_is_refused(line, command):
    line.fault(kind="refuse", slave="sensor", state="PREOP", code=0x51)
    code, _, err = command("state", "1003", "PREOP", *WHERE)
    assert code == 1
    assert err == (
        "slave 1003: refuses PREOP and is in INIT+ERROR: AL status code 0x0051, EEPROM error\n"
    )


def test_diag(line, command):
    assert document(command, "diag")["starts_at"] is None
    code, out, _ = command("diag", "buttons", *WHERE)
    assert code == 0
    assert "0 lost" in out


def test_eeprom_is_written_and_read_back(line, command, tmp_path):
    file = tmp_path / "image.bin"
    content = document(command, "sii", "dump", "sensor", str(file))
    assert file.read_bytes().hex() == content["data"]
    assert "0000  " in command("sii", "dump", "sensor", *WHERE)[1]
    octets = file.stat().st_size
    assert document(command, "sii", "write", "sensor", str(file))["octets"] == octets
    code, out, _ = command("sii", "write", "sensor", str(file), *WHERE)
    assert (code, out) == (0, f"slave 1003: {octets} bytes written and verified\n")


def test_vendor_message(monkeypatch, command):
    LoopBus("drive").replace(monkeypatch)
    words = ("voe", "drive", "0102", "--vendor", "0x12", "--vendor-type", "3")
    assert document(command, *words)["data"] == "0102"
    assert command(*words, *WHERE)[1] == "0102\n"


def test_slave_that_is_not_there(line, command):
    code, _, err = command("state", "nobody", *WHERE)
    assert code == 1
    assert "unknown slave 'nobody'" in err


BOTH = [
    (("scan",), "coe"),
    (("diag",), "coe"),
    (("diag", "sensor"), "coe"),
    (("state",), "coe"),
    (("state", "1003"), "coe"),
    (("state", "sensor", "SAFEOP"), "coe"),
    (("state", "OP"), "coe"),
    (("sdo", "read", "sensor", "0x8000:1"), "coe"),
    (("sdo", "read", "1003", "0x8000", "--complete"), "coe"),
    (("sdo", "write", "sensor", "0x8000:2", "-7"), "coe"),
    (("sdo", "list", "sensor"), "coe"),
    (("sdo", "dump", "sensor"), "coe"),
    (("sii", "dump", "buttons"), "coe"),
    (("idn", "read", "drive", "S-0-0032"), "drive"),
    (("idn", "write", "drive", "S-0-0032", "7"), "drive"),
    (("idn", "list", "drive"), "drive"),
    (("voe", "drive", "c0ffee", "--vendor", "1"), "drive"),
]


@pytest.mark.net
@pytest.mark.parametrize(("words", "name"), BOTH)
def test_port_of_a_station_is_as_good_as_an_interface(
    bus_appliance, monkeypatch, command, words, name
):
    LoopBus(name).replace(monkeypatch)
    verbs = 2 if words[0] in {"sdo", "sii", "idn"} else 1
    port = f"press/bus{['coe', 'drive'].index(name)}"
    for where in ((port, "PREOP"), ("PREOP", *WHERE)):
        assert command("state", *where)[0] == 0
    asked = command(*words[:verbs], port, *words[verbs:], "--json")
    own = command(*words, *WHERE, "--json")
    assert (asked[0], asked[2]) == (own[0], own[2]) == (0, "")
    lines, expected = (
        [json.loads(line) for line in out.splitlines()] for out in (asked[1], own[1])
    )
    if words[0] == "diag":
        for found in (lines[0], expected[0]):
            assert found.pop("frames")["sent"] > 0
    if words[1:2] == ("dump",) and words[0] == "sdo":
        for row in (*lines, *expected):  # inputs go up and down
            if row["index"] == 0x6000 and row["subindex"]:
                del row["value"], row["data"]
    assert lines == expected


@pytest.mark.net
def test_running_master_reports_findings(bus_appliance, command, tmp_path):
    assert "keeps it there" in command("state", "press/bus0", "sensor", "INIT")[1]
    assert "keeps them there" in command("state", "press/bus0", "PREOP")[1]
    file = tmp_path / "image.bin"
    assert command("sii", "dump", "press/bus0", "sensor", str(file))[0] == 0
    out = command("sii", "write", "press/bus0", "sensor", str(file))[1]
    assert "uses the old content" in out


@pytest.mark.net
@pytest.mark.parametrize(
    ("words", "code", "reason"),
    [
        (("scan", "press/eap0"), 1, "port eap0 of station press is no bus; its bus ports are bus0"),
        (("scan", "press/bus2"), 1, "no port 'bus2'; its bus ports are bus0, bus1, did you mean"),
        (("scan", "saw/bus0"), 1, "station saw has no port 'bus0'; it has no bus ports"),
        (("scan", "pres/bus0"), 1, "no station pres runs; running: works (press, saw), did you"),
        (("scan", "press/bus0", "--plant", "work"), 1, "no station press runs"),
        (("scan", "press/bus0/x"), 2, "'press/bus0/x' is not STATION/PORT"),
        (("state", "press/bus0", "nobody"), 1, "unknown slave 'nobody'"),
        (("voe", "press/bus0", "1001", "00", "--vendor", "1"), 1, "mailbox error"),
        (("sdo", "read", "press/bus0", "sensor", "0x8000:9"), 1, "subindex does not exist"),
    ],
)
def test_refusals(bus_appliance, command, words, code, reason):
    got, out, err = command(*words)
    assert (got, out) == (code, "")
    assert err.count("\n") == 1
    assert reason in err


@pytest.mark.net
def test_slave_that_does_not_answer(bus_appliance, command):
    with bus_appliance.lines[0].lost("sensor"):
        (row,) = document_of(command, "state", "press/bus0", "sensor")["slaves"]
        assert (row["state"], row["reason"]) == (None, "it does not answer")
        rows = document_of(command, "scan", "press/bus0")["slaves"]
        assert [row["state"] for row in rows] == ["OP", "OP", None]


def document_of(command, *words):
    code, out, err = command(*words, "--json")
    assert (code, err) == (0, "")
    return json.loads(out)
