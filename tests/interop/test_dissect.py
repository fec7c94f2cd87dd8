"""Three decoders that share no line read the same frames alike: ours, scapy layers, tshark."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from scapy.layers.l2 import Ether
from scapy.sendrecv import sniff
from scapy.sessions import TCPSession

from devicebus.wire.datagram import Command, Datagram, DatagramHeader
from devicebus.wire.datagram import encode_frame as encode_datagrams
from eap.codec.mailbox import MailboxHeader, MailboxType
from eap.codec.mailbox import encode_frame as encode_mailbox
from eap.codec.pd import PdFrameHeader, PdHeader, encode_frame
from eap.ids import NetId
from eap.ops.decode import decode_frame
from eap.recording.packets import iter_capture
from tests.support.packets import ethernet, tcp_segment, tcp_stream, udp
from tests.support.tshark import dissect, write_pcap
from tests.support.vectors import load, load_datagrams
from tools.scapy_layers import EtherCatFrame, Mailbox, ProcessData

needs_tshark = pytest.mark.tshark


def segments(frames: list[bytes]) -> list[bytes]:
    """One TCP connection, each frame in a segment of its own."""
    starts = itertools.accumulate(map(len, frames), initial=1)
    return [tcp_segment(frame, start) for frame, start in zip(frames, starts, strict=False)]


WRAPPERS: dict[str, Callable[[list[bytes]], list[bytes]]] = {
    "ethernet": lambda frames: [ethernet(frame) for frame in frames],
    "vlan": lambda frames: [ethernet(frame, vlan=0xE000) for frame in frames],
    "udp": lambda frames: [udp(frame) for frame in frames],
    "tcp": segments,
}


def whole(frame: bytes) -> bytes:
    """Cut the padding off."""
    return frame[: 2 + int.from_bytes(frame[:2], "little") % 2048]


def pd_frames() -> list[bytes]:
    """The vectors and 60 frames of any counts, lengths and values, the same in each run."""
    dice = random.Random(4)
    frames = [whole(vector.frame) for vector in load("type4_process_data")]
    for _ in range(60):
        header = PdFrameHeader(NetId(dice.randbytes(6)), 0, dice.getrandbits(16))
        pds = [
            (
                PdHeader(dice.getrandbits(16), dice.getrandbits(16), 0, dice.getrandbits(16)),
                dice.randbytes(dice.choice((1, 2, 3, 8, 60, 130))),
            )
            for _ in range(dice.randrange(11))
        ]
        frames.append(encode_frame(header, pds))
    frames.append(
        encode_frame(
            PdFrameHeader(NetId(b"\xff" * 6), 0, 0xFFFF), [(PdHeader(1, 2, 0), bytes(1450))]
        )
    )
    return frames


def mailbox_frames() -> list[bytes]:
    """The vectors and messages of every header value; data only where its layout is no matter."""
    dice = random.Random(5)
    stems = ("type5_mailbox", "type5_gateway", "high_nibble_dialect")
    vectors = [v for stem in stems for v in load(stem) if v.layer != "mailbox" and not v.error]
    frames = [whole(v.frame) for v in vectors]
    for _ in range(60):
        header = MailboxHeader(
            0,
            dice.getrandbits(16),
            dice.getrandbits(6),
            dice.getrandbits(2),
            MailboxType.VOE,
            dice.getrandbits(3),
        )
        frames.append(encode_mailbox(header, dice.randbytes(dice.randrange(6, 200))))
    return frames


def ours(frame: bytes) -> dict[str, Any]:
    fields = msgspec.to_builtins(decode_frame(frame))
    assert fields.pop("error") is None
    return fields


def by_scapy(octets: bytes) -> dict[str, Any]:
    frame = Ether(octets)[EtherCatFrame]
    fields = {"type": frame.type, "length": frame.length}
    if ProcessData in frame:
        content = frame[ProcessData]
        assert content.count == len(content.pds)
        return fields | {
            "publisher": ".".join(map(str, content.publisher)),
            "cycle": content.cycle,
            "pds": [
                {
                    "id": pd.id,
                    "version": pd.version,
                    "length": pd.length,
                    "quality": pd.quality,
                    "data": pd.data.hex(),
                }
                for pd in content.pds
            ],
        }
    message = frame[Mailbox]
    names = ("length", "address", "channel", "priority", "type", "counter")
    data = bytes(message.payload)[: message.length].hex()
    return fields | {"mailbox": {name: getattr(message, name) for name in names} | {"data": data}}


def common(fields: dict[str, Any]) -> dict[str, Any]:
    """Fields of a mailbox message that all three decoders know."""
    names = ("length", "address", "channel", "priority", "type", "counter", "data")
    return {name: fields["mailbox"][name] for name in names}


@pytest.mark.parametrize("wrap", WRAPPERS.values(), ids=WRAPPERS)
def test_scapy_reads_process_data_like_us(wrap: Callable) -> None:
    frames = pd_frames()
    assert [by_scapy(packet) for packet in wrap(frames)] == [ours(frame) for frame in frames]


@pytest.mark.parametrize("wrap", WRAPPERS.values(), ids=WRAPPERS)
def test_scapy_reads_mailboxes_like_us(wrap: Callable) -> None:
    frames = mailbox_frames()
    read = [common(by_scapy(packet)) for packet in wrap(frames)]
    assert read == [common(ours(frame)) for frame in frames]


def test_scapy_builds_the_bytes_it_read() -> None:
    for frame in pd_frames() + mailbox_frames():
        layers = EtherCatFrame(frame)
        for layer in (EtherCatFrame, Mailbox):
            if layer in layers:
                layers[layer].length = None
        assert bytes(layers) == frame


@needs_tshark
@pytest.mark.parametrize("transport", WRAPPERS)
def test_tshark_reads_process_data_like_us(transport: str, tmp_path: Path) -> None:
    frames = pd_frames()
    path = write_pcap(tmp_path / "all.pcap", WRAPPERS[transport](frames))
    seen = dissect(path)
    assert len(seen) == len(frames)
    for found, frame in zip(seen, frames, strict=True):
        assert not found["malformed"]
        assert found["transport"] == ("ethernet" if transport == "vlan" else transport)
        assert found["count"] == len(found["pds"])
        expected = ours(frame)
        assert {name: found[name] for name in expected} == expected


@needs_tshark
@pytest.mark.parametrize("transport", WRAPPERS)
def test_tshark_reads_mailboxes_like_us(transport: str, tmp_path: Path) -> None:
    frames = mailbox_frames()
    seen = dissect(write_pcap(tmp_path / "all.pcap", WRAPPERS[transport](frames)))
    assert len(seen) == len(frames)
    for found, frame in zip(seen, frames, strict=True):
        assert not found["malformed"]
        expected = ours(frame)
        assert (found["type"], found["length"]) == (expected["type"], expected["length"])
        assert found["mailbox"].items() <= expected["mailbox"].items()


def datagram_frames() -> list[bytes]:
    """The captured datagrams one by one, then up to eight of them in a frame, then logical ones."""
    datagrams = []
    for _, item in load_datagrams():
        command, data = Command[item["command"]], bytes.fromhex(item["data"])
        header = DatagramHeader(command, item["index"], item["adp"], item["ado"], 0)
        datagrams.append(Datagram(header, data, item["wkc"]))
    datagrams += [
        Datagram(DatagramHeader(command, 9, 0x5678, 0x1234, 0), bytes(30), 3)
        for command in (Command.LRD, Command.LWR, Command.LRW)
    ]
    together = [datagrams[start : start + 8] for start in range(0, len(datagrams), 8)]
    return [encode_datagrams(items) for items in [[datagram] for datagram in datagrams] + together]


@needs_tshark
def test_tshark_reads_datagrams_like_us(tmp_path: Path) -> None:
    frames = datagram_frames()
    seen = dissect(write_pcap(tmp_path / "all.pcap", map(ethernet, frames)))
    for found, frame in zip(seen, frames, strict=True):
        assert not found["malformed"]
        expected = ours(frame)["datagrams"]
        assert len(found["datagrams"]) == len(expected)
        for datagram, fields in zip(found["datagrams"], expected, strict=True):
            datagram["command"] = Command(datagram["command"]).name
            assert datagram.items() <= fields.items()


@needs_tshark
def test_tshark_marks_the_frames_that_we_refuse(tmp_path: Path) -> None:
    good = encode_frame(PdFrameHeader(NetId(bytes(6)), 0, 0), [(PdHeader(1, 0, 0), b"abcd")])
    too_many = bytearray(good)
    too_many[8] = 2
    too_long = bytearray(good)
    too_long[18] = 5
    message = encode_mailbox(MailboxHeader(0, type=MailboxType.VOE), bytes(8))
    long_message = bytearray(message)
    long_message[2] = 9
    broken = [bytes(too_many), bytes(too_long), bytes(long_message)]
    seen = dissect(write_pcap(tmp_path / "all.pcap", map(udp, [good, message, *broken])))
    assert [found["malformed"] for found in seen] == [False, False, True, True, True]
    assert all(decode_frame(frame).error for frame in broken)


@needs_tshark
def test_streams_cut_anywhere_hold_the_same_frames_for_all_three(tmp_path: Path) -> None:
    frames = pd_frames()
    dice = random.Random(6)
    cuts = [dice.randrange(sum(map(len, frames))) for _ in range(40)]
    path = write_pcap(tmp_path / "stream.pcap", tcp_stream(frames, cuts=cuts))
    captured = [found.data for found in iter_capture(path)]
    assert captured == frames
    seen = dissect(write_pcap(tmp_path / "frames.pcap", map(ethernet, captured)))
    assert [found["pds"] for found in seen] == [ours(frame)["pds"] for frame in frames]


def test_scapy_puts_streams_together_like_us(tmp_path: Path) -> None:
    frames = pd_frames()
    path = write_pcap(tmp_path / "stream.pcap", tcp_stream(frames, cuts=range(13, 99_999, 13)))
    packets = sniff(offline=str(path), session=TCPSession)
    found = [
        layer.pds
        for packet in packets
        for layer in packet.iterpayloads()
        if isinstance(layer, ProcessData)
    ]
    expected = [ours(frame)["pds"] for frame in frames]
    assert [[pd.data.hex() for pd in pds] for pds in found] == [
        [pd["data"] for pd in pds] for pds in expected
    ]
    assert [captured.data for captured in iter_capture(path)] == frames
