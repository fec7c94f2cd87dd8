from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.errors import MalformedError
from eap.recording.packets import CapturedFrame, iter_capture
from tests.support.packets import ethernet, tcp_segment, tcp_stream, udp
from tests.support.tshark import write_pcap

FRAME = bytes.fromhex("0240abcd")
OTHER = bytes.fromhex("0350a1a2a3")


def block(kind: int, body: bytes) -> bytes:
    body += bytes(-len(body) % 4)
    size = 12 + len(body)
    return struct.pack("<II", kind, size) + body + struct.pack("<I", size)


def write_pcapng(path: Path, packets: list[bytes], link_type: int = 1) -> Path:
    """Blocks as the pcapng draft gives them: section, interface with nanoseconds, packets."""
    content = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    content += block(1, struct.pack("<HHI", link_type, 0, 0) + struct.pack("<HHB3x", 9, 1, 9))
    content += block(5, b"statistics, which are skipped...")
    for number, octets in enumerate(packets):
        at = 1_700_000_000_000_000_000 + number * 1_000_000
        head = struct.pack("<IIIII", 0, at >> 32, at & 0xFFFFFFFF, len(octets), len(octets))
        content += block(6, head + octets)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("write", [write_pcap, write_pcapng])
def test_frames_of_every_transport_in_order(tmp_path: Path, write: object) -> None:
    packets = [ethernet(FRAME), ethernet(b"", ethertype=0x0806), udp(OTHER), *tcp_stream([OTHER])]
    found = list(iter_capture(write(tmp_path / "file", packets)))
    assert [(c.number, c.packet.transport) for c in found] == [
        (1, "ethernet"),
        (3, "udp"),
        (7, "tcp"),
    ]
    assert [c.data[:5].rstrip(b"\0") for c in found] == [FRAME, OTHER, OTHER]
    times = [c.at_ns - 1_700_000_000_000_000_000 for c in found]
    assert times == pytest.approx([0, 2_000_000, 6_000_000], abs=1000)


def test_both_directions_of_a_connection_are_streams_of_their_own(tmp_path: Path) -> None:
    packets = [
        tcp_segment(FRAME[:3], 10),
        tcp_segment(OTHER[:2], 50, reply=True),
        tcp_segment(FRAME[3:] + OTHER, 13),
        tcp_segment(OTHER[2:], 52, reply=True),
    ]
    found = list(iter_capture(write_pcap(tmp_path / "file", packets)))
    assert [(c.number, c.data) for c in found] == [(3, FRAME), (3, OTHER), (4, OTHER)]
    assert found[2].packet.source == "127.0.1.1:34980"


def test_unfinished_frame_comes_last(tmp_path: Path) -> None:
    packets = [tcp_segment(FRAME[:3], 10), udp(OTHER)]
    found = list(iter_capture(write_pcap(tmp_path / "file", packets)))
    assert [(c.number, c.data) for c in found] == [(2, OTHER), (1, FRAME[:3])]


def test_capture_of_nothing_of_ours_is_empty(tmp_path: Path) -> None:
    assert list(iter_capture(write_pcap(tmp_path / "file", []))) == []


def test_other_link_type_is_refused(tmp_path: Path) -> None:
    path = write_pcapng(tmp_path / "any.pcapng", [], link_type=113)
    with pytest.raises(MalformedError, match=r"any.pcapng.*link type 113, expected 1, Ethernet"):
        list(iter_capture(path))


@pytest.mark.parametrize("content", [b"", b"not a capture", b"\n\r\r\n"], ids=repr)
def test_other_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(MalformedError, match="no whole pcap or pcapng file"):
        list(iter_capture(path))


def test_damaged_file_yields_what_is_before_the_damage(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "file", [udp(FRAME), udp(OTHER)])
    path.write_bytes(path.read_bytes()[: 24 + 16 + len(udp(FRAME)) + 7])
    frames = iter_capture(path)
    assert isinstance(next(frames), CapturedFrame)
    with pytest.raises(MalformedError, match="no whole pcap"):
        next(frames)


def test_missing_file_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        list(iter_capture(tmp_path / "missing"))


@given(st.data())
def test_damage_anywhere_is_taken_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "file"
    write = data.draw(st.sampled_from((write_pcap, write_pcapng)))
    content = bytearray(write(path, [ethernet(FRAME), udp(OTHER)]).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        list(iter_capture(path))
    except MalformedError as exc:
        assert str(path) in str(exc)  # noqa: PT017  the message must name the file
