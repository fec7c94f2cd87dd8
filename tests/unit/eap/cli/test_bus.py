"""``eapctl bus``: scan, state, diag, sii and voe."""

from __future__ import annotations

import json

import pytest

from eap.cli import main
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


def test_state_that_there_is_not(line, command):
    code, _, err = command("state", "sensor", "RUN", *WHERE)
    assert code == 2
    assert "'RUN' is not a state, expected one of INIT, PREOP" in err


def test_state_that_is_refused(line, command):
    line.fault(kind="refuse", slave="sensor", state="PREOP", code=0x51)
    code, _, err = command("state", "1003", "PREOP", *WHERE)
    assert code == 1
    assert err == (
        "slave 1003: refuses PREOP and stands in INIT+ERROR: AL status code 0x0051, EEPROM error\n"
    )


def test_diag(line, command):
    assert document(command, "diag")["starts_at"] is None
    code, out, _ = command("diag", "buttons", *WHERE)
    assert code == 0
    assert "0 lost" in out


def test_eeprom_there_and_back(line, command, tmp_path):
    file = tmp_path / "image.bin"
    content = document(command, "sii", "dump", "sensor", str(file))
    assert file.read_bytes().hex() == content["data"]
    assert "0000  " in command("sii", "dump", "sensor", *WHERE)[1]
    octets = file.stat().st_size
    assert document(command, "sii", "write", "sensor", str(file))["octets"] == octets
    code, out, _ = command("sii", "write", "sensor", str(file), *WHERE)
    assert (code, out) == (0, f"slave 1003: {octets} octets written and compared\n")


def test_vendor_message(monkeypatch, command):
    LoopBus("drive").replace(monkeypatch)
    words = ("voe", "drive", "0102", "--vendor", "0x12", "--vendor-type", "3")
    assert document(command, *words)["data"] == "0102"
    assert command(*words, *WHERE)[1] == "0102\n"


def test_slave_that_is_not_there(line, command):
    code, _, err = command("state", "nobody", *WHERE)
    assert code == 1
    assert "there is no slave 'nobody'" in err


def test_port_of_a_station(command):
    code, _, err = command("scan", "island-01/bus0")
    assert code == 2
    assert err.count("\n") == 1
    assert "ports of running stations have no bus yet" in err
