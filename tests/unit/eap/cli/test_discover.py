"""``eapctl discover`` from captures: rows, notes, comparison with plants, written plant files."""

from __future__ import annotations

import json
import os
import random
import struct
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import dpkt
import pytest
from click.testing import CliRunner, Result

from eap.cli.group import main
from eap.codec.ethercat import EtherCatHeader
from eap.codec.pd import PdFrameHeader, PdHeader, encode_frame
from eap.ids import NetId
from eap.pd.rhythm import swap
from eap.runtime.plantfile import load_plant
from tests.support.packets import ethernet, udp
from tests.support.tshark import write_pcap

KEYS = [
    "publisher",
    "pd_id",
    "version",
    "length",
    "rate_hz",
    "jitter_us",
    "destination",
    "taken_by",
]
MIXER, OVEN = "10.0.0.1.2.1", "5.23.91.23.2.1"
PLANT = """
plant: receivers
stations:
  - name: panel
    net_id: 10.0.9.9.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.0.1.1", net_id: 10.0.9.9.2.1}
    subscribe:
      - {name: mixer, port: eap0, from: {publisher: 10.0.0.1.2.1, id: 7}, foreign: true,
         version: 3, variables: {count: UDINT}}
      - {name: other, port: eap0, from: {publisher: 10.0.0.1.2.1, id: 8}, foreign: true,
         version: 9, variables: {flag: BYTE}}
"""


def frame(publisher: str, cycle: int, *pds: tuple[int, int, bytes]) -> bytes:
    """A frame with PDs of (ID, version, data)."""
    rows = [(PdHeader(pd_id, version, 0), data) for pd_id, version, data in pds]
    return encode_frame(PdFrameHeader(NetId.parse(publisher), 0, cycle), rows)


def mixer(cycles: Iterable[int] = range(40)) -> Iterator[bytes]:
    for n in cycles:
        yield udp(frame(MIXER, n, (7, 3, struct.pack("<I", n)), (8, 1, b"\x01")))


def oven(cycles: Iterable[int] = range(40)) -> Iterator[bytes]:
    for n in cycles:
        yield ethernet(frame(OVEN, n, (1, 0, struct.pack("<f", 180.5 + n))), vlan=7)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    pairs = zip(mixer(), oven(), strict=True)
    return write_pcap(tmp_path / "line.pcap", (octets for pair in pairs for octets in pair))


@pytest.fixture(autouse=True)
def _nothing_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / "run"))


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["discover", *map(str, arguments)])


def rows(result: Result) -> list[dict]:
    return [json.loads(line) for line in result.stdout.splitlines()]


def test_each_pd_of_a_capture_is_an_object(capture: Path) -> None:
    result = run("--pcap", capture, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    found = rows(result)
    assert [(row["publisher"], row["pd_id"]) for row in found] == [
        (OVEN, 1),
        (MIXER, 7),
        (MIXER, 8),
    ]
    assert all(list(row)[: len(KEYS)] == KEYS for row in found)
    assert {key: found[0][key] for key in KEYS} == {
        "publisher": OVEN,
        "pd_id": 1,
        "version": 0,
        "length": 4,
        "rate_hz": pytest.approx(500, rel=0.01),
        "jitter_us": pytest.approx(0, abs=1),
        "destination": "01:01:05:04:00:00",
        "taken_by": None,
    }
    assert (found[0]["vlan_id"], found[0]["destination_kind"]) == (7, "multicast")
    assert (found[1]["destination"], found[1]["transport"]) == ("127.0.1.1", "udp")
    assert [row["trigger"] for row in found] == ["cycle"] * 3
    assert found[0]["looks_like"] == ["bytes 0 to 3: REAL, 180.5 to 211.5"]


def test_rows_name_the_subscriptions_of_a_plant_file(capture: Path, tmp_path: Path) -> None:
    plant = tmp_path / "plant.yaml"
    plant.write_text(PLANT)
    found = rows(run("--pcap", capture, "--plant", plant, "--json"))
    assert [row["taken_by"] for row in found] == [None, "panel/mixer", None]
    assert found[2]["refused_by"] == [{"entry": "panel/other", "reason": "version"}]
    shown = run("--pcap", capture, "--plant", plant)
    assert "3 PDs of 2 publishers, 1 taken" in shown.stdout
    assert "PD 8 of 10.0.0.1.2.1: panel/other drops it: another version than 1" in shown.stderr


def test_written_plant_has_no_errors_and_takes_each_pd(capture: Path, tmp_path: Path) -> None:
    target = tmp_path / "found.yaml"
    result = run("--pcap", capture, "--write", target, "--json")
    assert result.stderr == f"{target}: 3 subscriptions written\n"
    loaded = load_plant(target)
    assert loaded.findings == ()
    assert loaded.plant is not None
    (station,) = loaded.plant.stations
    assert [(pd.pd_id, pd.publisher, pd.step) for pd in station.subscriptions] == [
        (1, OVEN, 1),
        (7, MIXER, 1),
        (8, MIXER, 1),
    ]
    text = target.read_text()
    assert "BLOCK(4)" in text
    assert "# looks like bytes 0 to 3: REAL, 180.5 to 211.5" in text
    again = rows(run("--pcap", capture, "--plant", target, "--json"))
    assert all(row["taken_by"] for row in again)


def test_existing_file_is_kept_without_force(capture: Path, tmp_path: Path) -> None:
    target = tmp_path / "found.yaml"
    target.write_text("mine")
    assert run("--pcap", capture, "--write", target).exit_code == 2
    assert target.read_text() == "mine"
    assert run("--pcap", capture, "--write", target, "--force").exit_code == 0


def test_frames_to_other_hosts_are_stations_of_their_own(tmp_path: Path) -> None:
    octets = [bytearray(each) for each in mixer(range(8))]
    for each in octets:
        each[30:34] = bytes([192, 168, 0, 7])
    broadcast = [bytearray(each) for each in mixer(range(8))]
    for each in broadcast:
        each[30:34] = bytes([255] * 4)
    path = write_pcap(tmp_path / "x.pcap", [bytes(each) for each in octets + broadcast])
    target = tmp_path / "found.yaml"
    run("--pcap", path, "--write", target)
    plant = load_plant(target).plant
    assert plant is not None
    assert [station.name for station in plant.stations] == ["here", "at-192.168.0.7"]
    here, there = (station.ports[0] for station in plant.stations)
    assert (str(here.interface), here.broadcast) == ("udp://0.0.0.0", True)
    assert (str(there.interface), there.ams) == ("udp://192.168.0.7", False)


def odd_sender() -> Iterator[bytes]:
    """A tool that writes Length 4 always, and swaps the bytes of its counter."""
    for n in range(20):
        whole = frame(OVEN, swap(n), (5, 0, b"ab"))
        yield ethernet(EtherCatHeader(4).encode() + whole[2:])


def test_odd_senders_are_named_and_get_a_lenient_port(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "odd.pcap", odd_sender())
    target = tmp_path / "found.yaml"
    result = run("--pcap", path, "--write", target)
    assert "5.23.91.23.2.1: wrong length in its EtherCAT header (4)" in result.stderr
    assert "5.23.91.23.2.1: its cycle counter is byte-swapped" in result.stderr
    plant = load_plant(target).plant
    assert plant is not None
    station = plant.stations[0]
    assert station.ports[0].length == "lenient"
    assert station.subscriptions[0].step == 0  # losses cannot be counted
    decoded = CliRunner().invoke(main, ["decode", str(path), "--json"])
    last = json.loads(decoded.stdout.splitlines()[-1])
    assert (last["cycle_order"], last["needed_length"], last["pds"][0]["id"]) == ("swapped", 22, 5)
    assert "wrong length 4" in last["error"]
    assert "(byte-swapped: 19)" in CliRunner().invoke(main, ["decode", str(path)]).stdout


def test_two_senders_with_one_net_id_are_named(tmp_path: Path) -> None:
    second = [bytearray(each) for each in oven()]
    for each in second:
        each[11] = 0x99
    path = write_pcap(tmp_path / "two.pcap", [*oven(), *map(bytes, second)])
    assert f"{OVEN}: sent from 2 addresses" in run("--pcap", path).stderr


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("none.pcap", "No such file or directory"),
        ("folder", "it is a folder"),
        ("pipe", "it is no regular file"),
    ],
)
def test_capture_that_is_no_file_is_refused_with_the_reason(
    tmp_path: Path, name: str, reason: str
) -> None:
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    path = tmp_path / name
    result = run("--pcap", path)
    assert (result.exit_code, result.stderr) == (2, f"{path} cannot be read: {reason}\n")


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("-", "the result is a file: name one instead of -"),
        ("none/p.yaml", "none/p.yaml cannot be written: no folder none"),
        ("line.pcap", "line.pcap exists: overwrite it with --force"),
    ],
)
def test_plant_file_that_cannot_be_made_is_refused_at_once(
    capture: Path, monkeypatch: pytest.MonkeyPatch, target: str, reason: str
) -> None:
    monkeypatch.chdir(capture.parent)
    result = run("--pcap", capture, "--write", target)
    assert (result.exit_code, result.stdout, result.stderr) == (2, "", f"{reason}\n")
    assert not Path("-").exists()


def test_plant_in_a_file_with_spaces_has_a_name_without(capture: Path, tmp_path: Path) -> None:
    target = tmp_path / "my plant.yaml"
    assert run("--pcap", capture, "--write", target).exit_code == 0
    found = load_plant(target)
    assert found.findings == ()
    assert found.plant is not None
    assert found.plant.name == "my_plant"


def test_truncated_capture_shows_what_came_before(capture: Path) -> None:
    octets = capture.read_bytes()
    for size in (0, 10, 24, 30, 200, len(octets) - 5):
        capture.write_bytes(octets[:size])
        result = run("--pcap", capture, "--json")
        assert result.exception is None or isinstance(result.exception, SystemExit)
        assert result.exit_code in {0, 1, 2}
        assert "Traceback" not in result.stderr
    assert len(rows(result)) == 3
    capture.write_bytes(octets[:12])
    assert "no whole pcap or pcapng file" in run("--pcap", capture).stderr


def statistics(order: str, *options: tuple[int, int]) -> bytes:
    """An Interface Statistics Block of pcapng."""
    body = struct.pack(f"{order}III", 0, 0, 0)
    for code, count in options:
        body += struct.pack(f"{order}HHQ", code, 8, count)
    body += bytes(4)
    size = len(body) + 12
    return struct.pack(f"{order}II", 5, size) + body + struct.pack(f"{order}I", size)


def test_losses_that_a_pcapng_file_tells_are_shown(tmp_path: Path) -> None:
    path = tmp_path / "x.pcapng"
    with path.open("wb") as file:
        writer = dpkt.pcapng.Writer(file)
        for number, octets in enumerate(mixer(range(8))):
            writer.writepkt(octets, ts=number / 100)
        file.write(statistics("<" if sys.byteorder == "little" else ">", (4, 8), (5, 3), (7, 4)))
    result = run("--pcap", path, "--json")
    assert (result.exit_code, len(rows(result))) == (0, 2)
    assert "capture: 7 packets lost" in result.stderr
    whole = path.read_bytes()
    for size in range(len(whole) - 60, len(whole)):
        path.write_bytes(whole[:size])
        assert run("--pcap", path).exit_code in {0, 2}


def test_hostile_packets_do_no_harm(tmp_path: Path) -> None:
    noise = random.Random(4)
    packets = [noise.randbytes(noise.randrange(200)) for _ in range(200)]
    packets += [udp(noise.randbytes(noise.randrange(100))) for _ in range(300)]
    packets += [ethernet(b"\x40\x40" + noise.randbytes(90)) for _ in range(300)]
    result = run("--pcap", write_pcap(tmp_path / "x.pcap", packets), "--write", tmp_path / "p.yaml")
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert "malformed" in result.stderr
    if (tmp_path / "p.yaml").exists():
        assert load_plant(tmp_path / "p.yaml").findings == ()


def test_capture_without_process_data_fails(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "x.pcap", [udp(EtherCatHeader(6, type=7).encode() + bytes(6))])
    result = run("--pcap", path)
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr == "no process data, but other EtherCAT frames: type 7: 1\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "nothing to look at"),
        (["eth0", "--pcap", "x"], "omit one"),
        (["--pcap", "x", "--for", "3"], "--for goes with INTERFACE"),
        (["--pcap", "nosuchfile"], "nosuchfile"),
        (["nosuchinterface"], "there is no interface 'nosuchinterface'"),
    ],
)
def test_wrong_usage_is_explained(words: list[str], message: str) -> None:
    result = run(*words)
    assert result.exit_code != 0
    assert message in result.stderr + str(result.exception)


def test_narrow_terminal_keeps_publisher_trigger_and_taker(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = run("--pcap", capture).stdout.splitlines()
    assert all(len(line) <= 80 for line in lines)
    for word in ("Publisher", "Sent", "To", "Taken by"):
        assert word in lines[0]
