from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from scapy.layers.inet import IP, TCP, UDP
from scapy.layers.l2 import Dot1Q, Ether
from scapy.packet import Packet, Padding, Raw

from tools.scapy_layers import EtherCatFrame, Mailbox, ProcessData, ProcessDataUnit

PD_FRAME = bytes.fromhex("1640 aabbccddeeff 0100 4d00 0000 0100 3412 0200 0500 6162")
MESSAGE = bytes.fromhex("0950 0300 e903 c1 23 616263")


def test_process_data_builds_and_reads() -> None:
    pd = ProcessDataUnit(id=1, version=0x1234, quality=5, data=b"ab")
    content = ProcessData(publisher=bytes.fromhex("aabbccddeeff"), cycle=77, pds=[pd])
    assert bytes(EtherCatFrame() / content) == PD_FRAME
    read = EtherCatFrame(PD_FRAME + b"\0\0")
    assert (read.type, read.length, read[ProcessData].count) == (4, 22, 1)
    assert (read.pds[0].id, read.pds[0].version, read.pds[0].quality) == (1, 0x1234, 5)
    assert (read.pds[0].data, read[Padding].load) == (b"ab", b"\0\0")
    assert "170.187.204.221.238.255" in read[ProcessData].show(dump=True)


def test_mailbox_builds_and_reads() -> None:
    header = Mailbox(address=1001, channel=1, priority=3, type=3, counter=2)
    assert bytes(EtherCatFrame(type=5) / header / Raw(b"abc")) == MESSAGE
    read = EtherCatFrame(MESSAGE + b"\0")[Mailbox]
    assert [getattr(read, name) for name in ("length", "address", "channel", "priority")] == [
        3,
        1001,
        1,
        3,
    ]
    assert (read.type, read.counter, read[Raw].load) == (3, 2, b"abc")


@pytest.mark.parametrize(
    "below",
    [
        Ether(),
        Ether() / Dot1Q(vlan=5),
        Ether() / IP() / UDP(dport=34980),
        Ether() / IP() / UDP(sport=34980, dport=40000),
        Ether() / IP() / TCP(dport=34980),
        Ether() / IP() / TCP(sport=34980, dport=40000),
    ],
    ids=["ethernet", "vlan", "udp", "udp reply", "tcp", "tcp reply"],
)
def test_bound_to_every_transport(below: Packet) -> None:
    read = Ether(bytes(below / EtherCatFrame(PD_FRAME)))
    assert read[ProcessData].cycle == 77


def test_stream_waits_for_a_whole_frame() -> None:
    assert EtherCatFrame.tcp_reassemble(PD_FRAME[:1], {}, {}) is None
    assert EtherCatFrame.tcp_reassemble(PD_FRAME[:-1], {}, {}) is None
    assert EtherCatFrame.tcp_reassemble(PD_FRAME + b"x", {}, {})[Padding].load == b"x"


def test_scapy_layers_do_not_import_the_codec() -> None:
    code = "import sys, tools.scapy_layers; print([m for m in sys.modules if m[:3] == 'eap'])"
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
