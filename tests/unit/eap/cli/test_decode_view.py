from __future__ import annotations

import pytest
from rich.console import Console

from eap.cli.decode import frame_view
from eap.ops.decode import decode_frame
from tests.support.vectors import Vector, load_all


def render(octets: bytes, **origin: object) -> str:
    console = Console(width=200, color_system=None)
    with console.capture() as capture:
        frame = decode_frame(octets)
        for name, value in origin.items():
            setattr(frame, name, value)
        for part in frame_view(frame):
            console.print(part)
    return capture.get()


def test_process_data_with_its_origin() -> None:
    frame = bytes.fromhex("1540 c0a800010101 0100 0100 0000 e903 0700 0100 1900 01")
    text = render(
        frame,
        packet=3,
        time=1_700_000_000.25,
        transport="ethernet",
        vlan_id=5,
        source="A",
        destination="B",
    )
    assert text.splitlines() == [
        (
            "#3 22:13:20.250000  ethernet VLAN 5 A → B  type 4 (process data), 21 bytes  "
            "publisher 192.168.0.1.1.1, cycle 1"
        ),
        "└── PD 1001 (0x03e9)  version 7  quality 2.5 ms  [01]",
    ]


def test_datagrams() -> None:
    text = render(
        bytes.fromhex("1910 04ce e903 3001 0180 0000 02 0100 0c01 78563412 0000 0000 0300")
    )
    assert "FPRD  index 206  ADP 0x03e9  ADO 0x0130  WKC 1  [02]" in text
    assert "LRW  index 1  address 0x12345678  WKC 3  []" in text


def test_ams_in_a_mailbox() -> None:
    header = "c0a800010201 e903 c0a800320101 0080 0200 0500 00000000 06000000 01000000"
    text = render(bytes.fromhex(f"2650 2000 e903 00 31 {header}"))
    assert "AoE  address 1001  counter 3  priority 0\n" in text
    assert (
        "AMS READ response 1  192.168.0.50.1.1:32768 → 192.168.0.1.2.1:1001  error 0x6  []" in text
    )


def test_error_reply_has_its_reason() -> None:
    text = render(bytes.fromhex("0a50 0400 e903 00 10 0100 0200"))
    assert "refused: UNSUPPORTED_PROTOCOL (0x0002)" in text


def test_undocumented_type_and_long_data() -> None:
    text = render(b"\x28\x70" + bytes(40))
    assert "type 7 (undocumented), 40 bytes" in text
    assert "00 … (40 bytes)]" in text


def test_error_is_a_line_of_its_own() -> None:
    assert "└── error: EtherCatHeader at offset 0" in render(b"\x15\x40")
    assert render(b"\x15").startswith("not an EtherCAT frame")


@pytest.mark.parametrize("vector", load_all("ethernet", "frame"), ids=lambda v: v.name)
def test_every_vector_has_a_tree(vector: Vector) -> None:
    octets = vector.octets if vector.error else vector.frame
    assert render(octets).startswith("type ")
