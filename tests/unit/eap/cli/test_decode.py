from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from eap.cli.group import main
from eap.codec.pd import PdFrameHeader, PdHeader, encode_frame
from eap.ids import NetId
from tests.support.packets import ethernet, tcp_segment, tcp_stream, udp
from tests.support.tshark import write_pcap

FRAME = bytes.fromhex("1540 c0a800010101 0100 0100 0000 e903 0000 0100 0000 01")
DECODED = {
    "type": 4,
    "length": 21,
    "publisher": "192.168.0.1.1.1",
    "cycle": 1,
    "pds": [{"id": 1001, "version": 0, "length": 1, "quality": 0, "data": "01"}],
    "error": None,
}


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["decode", *map(str, arguments)])


def lines(result: Result) -> list[dict]:
    return [json.loads(line) for line in result.stdout.splitlines()]


@pytest.mark.parametrize(
    "words",
    [
        [FRAME.hex()],
        [FRAME.hex(" ").upper()],
        FRAME.hex(" ").split(),
        [f"0x{FRAME.hex()}"],
        [FRAME.hex(":", 2)],
        [f" {FRAME.hex()}\n"],
    ],
    ids=["digits", "spaces", "words", "0x", "colons", "newline"],
)
def test_hex_in_any_spelling(words: list[str]) -> None:
    result = run(*words, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    assert lines(result) == [DECODED]


@pytest.mark.parametrize(
    ("octets", "origin"),
    [
        (
            ethernet(FRAME),
            {
                "transport": "ethernet",
                "source": "02:01:05:00:00:01",
                "destination": "01:01:05:04:00:00",
            },
        ),
        (
            ethernet(FRAME, vlan=0x2005),
            {
                "transport": "ethernet",
                "source": "02:01:05:00:00:01",
                "destination": "01:01:05:04:00:00",
                "vlan_id": 5,
            },
        ),
        (
            udp(FRAME),
            {
                "transport": "udp",
                "source": "127.0.1.2:34980",
                "destination": "127.0.1.1:34980",
            },
        ),
    ],
    ids=["ethernet", "vlan", "udp"],
)
def test_hex_of_a_whole_ethernet_frame(octets: bytes, origin: dict) -> None:
    result = run(octets.hex(), "--json")
    assert result.exit_code == 0
    assert lines(result) == [DECODED | origin]


def test_hex_of_a_tcp_segment_may_hold_several_frames_and_a_begun_one() -> None:
    result = run(tcp_segment(FRAME + FRAME + FRAME[:3], 0).hex(), "--json")
    first, second, begun = lines(result)
    assert first["pds"] == second["pds"] == DECODED["pds"]
    assert "length 21, but 1 bytes follow" in begun["error"]
    assert result.exit_code == 1


def test_long_hex_is_no_file_name() -> None:
    frame = encode_frame(PdFrameHeader(NetId(bytes(6)), 0, 0), [(PdHeader(1, 0, 0), bytes(1400))])
    result = run(frame.hex(), "--json")
    assert lines(result)[0]["pds"][0]["length"] == 1400


def test_frame_with_an_error_is_shown_and_fails() -> None:
    result = run(FRAME[:-1].hex(), "--json")
    assert result.exit_code == 1
    (fields,) = lines(result)
    assert fields["publisher"] == "192.168.0.1.1.1"
    assert "length 21, but 20 bytes follow" in fields["error"]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["missing.pcap"], "'missing.pcap' is neither a file nor hexadecimal digits"),
        (["zz" * 400], "is neither a file nor hexadecimal digits"),
        (["/"], "Is a directory: '/'"),
        (["123"], "neither a file nor hexadecimal"),
        ([""], "no bytes to decode: give HEX or FILE"),
        ([], "Missing argument 'HEX|FILE'"),
    ],
)
def test_unusable_input(words: list[str], reason: str) -> None:
    result = run(*words, "--json")
    assert (result.exit_code, result.stdout) == (2, "")
    assert reason in result.stderr
    assert result.stderr.count("\n") == 1


def test_capture(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "a.pcap", [udp(FRAME), *tcp_stream([FRAME, FRAME], cuts=[30])])
    result = run(path, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    found = lines(result)
    assert [(f["packet"], f["transport"]) for f in found] == [(1, "udp"), (5, "tcp"), (6, "tcp")]
    assert [f["time"] for f in found] == pytest.approx(
        [1_700_000_000 + n / 1000 for n in (0, 4, 5)]
    )
    assert all(fields.items() >= DECODED.items() for fields in found)


def test_capture_with_one_bad_frame_fails_after_showing_all(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "a.pcap", [udp(FRAME[:-1]), udp(FRAME)])
    result = run(path, "--json")
    assert result.exit_code == 1
    assert [fields["error"] is None for fields in lines(result)] == [False, True]


def test_decode_reports_a_capture_without_ethercat_frames(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "a.pcap", [udp(FRAME, source_port=1, port=2)])
    result = run(path, "--json")
    assert (result.exit_code, result.stdout) == (0, "")
    assert "no EtherCAT frame" in result.stderr


def test_file_that_is_no_capture(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("hello")
    result = run(path)
    assert (result.exit_code, result.stdout) == (2, "")
    assert "notes.txt" in result.stderr
    assert "no whole pcap or pcapng file" in result.stderr


def test_gw_od_prints_a_tree() -> None:
    result = run(udp(FRAME).hex())
    assert result.exit_code == 0
    for part in ("127.0.1.2:34980 → 127.0.1.1:34980", "publisher 192.168.0.1.1.1", "PD 1001"):
        assert part in result.stdout


def test_help_imports_no_decoder() -> None:
    code = (
        "import sys, eap.cli.decode;"
        "slow = {'dpkt', 'rich', 'msgspec', 'eap.ops.decode', 'eap.recording.packets'};"
        "print(sorted(slow & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
