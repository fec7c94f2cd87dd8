"""pcapng files: golden bytes of blocks and headers; tests/interop asks tshark."""

from __future__ import annotations

from pathlib import Path

import pytest

from eap.ids import MacAddr
from eap.recording.frames_writer import (
    FramesWriter,
    ethernet_wrapping,
    interface_block,
    udp_wrapping,
)
from eap.recording.header import AttachedFile, EventKind, RecordingEvent, RecordingHeader
from eap.recording.packets import capture_drops, iter_capture

T0 = 1_700_000_000_123_456_789
FRAME = bytes.fromhex("0c40 7f0001010201 0000 0100 0000")


def header(content: bytes = b"plant: mill\n") -> RecordingHeader:
    return RecordingHeader(
        plant="mill", host="pc", started_ns=T0, files=(AttachedFile("mill.yaml", content),)
    )


def test_udp_header_has_a_valid_checksum() -> None:
    packet = udp_wrapping(("127.0.1.1", 34980), ("127.0.1.2", 34980)).wrap(FRAME)
    assert packet[:14] == bytes.fromhex("0200 7f000102 0200 7f000101 0800")
    ip = packet[14:34]
    words = sum(int.from_bytes(ip[at : at + 2], "big") for at in range(0, 20, 2))
    assert words % 0xFFFF == 0
    assert int.from_bytes(ip[2:4], "big") == 28 + len(FRAME)
    assert packet[34:42] == bytes.fromhex("88a4 88a4 0016 0000")
    assert packet[42:] == FRAME


def test_ethernet_header_has_the_vlan_tag() -> None:
    macs = MacAddr.parse("02:00:00:00:00:01"), MacAddr.parse("01:01:05:04:00:00")
    assert ethernet_wrapping(*macs, vlan=0xE003).wrap(b"xy") == bytes.fromhex(
        "010105040000 020000000001 8100e003 88a4 7879"
    )
    assert ethernet_wrapping(*macs).wrap(b"") == bytes.fromhex("010105040000 020000000001 88a4")


def test_interface_block_is_padded_and_in_nanoseconds() -> None:
    assert interface_block("a", "udp:") == bytes.fromhex(
        "01000000 30000000 0100 0000 00000000"
        "0200 0100 61000000"
        "0300 0400 7564703a"
        "0900 0100 09000000"
        "0000 0000 30000000"
    )


@pytest.mark.parametrize("size", range(14, 19))
def test_our_own_reader_finds_every_frame(tmp_path: Path, size: int) -> None:
    path = tmp_path / "a.pcapng"
    frame = FRAME.ljust(size, b"\0")
    writer = FramesWriter(path, header(b"x" * 150_000))
    port = writer.add_interface("island-01/eap0", "udp://127.0.1.1")
    wrapping = udp_wrapping(("127.0.1.1", 34980), ("127.0.1.2", 34980))
    for number in range(5):
        writer.write(port, T0 + number, wrapping.wrap(frame), outbound=True)
    writer.close(T0 + 9)
    assert writer.frames == 5
    assert writer.size == path.stat().st_size
    assert [each.data for each in iter_capture(path)] == [frame] * 5


def test_losses_are_in_the_statistics(tmp_path: Path) -> None:
    path = tmp_path / "a.pcapng"
    writer = FramesWriter(path, header())
    port = writer.add_interface("island-01/eap0", "udp://127.0.1.1")
    writer.add_event(RecordingEvent(time_ns=T0, kind=EventKind.LOST, count=7), port)
    writer.close(T0)
    assert writer.lost == 7
    assert capture_drops(path) == 7


def test_frames_are_in_the_file_half_a_second_later(tmp_path: Path) -> None:
    path = tmp_path / "a.pcapng"
    writer = FramesWriter(path, header())
    port = writer.add_interface("island-01/eap0", "udp://127.0.1.1")
    wrapping = udp_wrapping(("127.0.1.1", 34980), ("127.0.1.2", 34980))
    for number in range(100):
        writer.write(port, T0 + number * 10_000_000, wrapping.wrap(FRAME), outbound=False)
    # 1 s of frames, and nothing was closed: what a killed recorder leaves.
    assert len(list(iter_capture(path))) >= 50
    writer.abandon()


def test_frames_writer_leaves_an_existing_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.pcapng"
    path.write_bytes(b"precious")
    with pytest.raises(FileExistsError):
        FramesWriter(path, header())
    assert path.read_bytes() == b"precious"
