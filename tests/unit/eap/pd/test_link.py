from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from eap.codec.pd import decode_frame_header
from eap.pd.device import DeviceState
from eap.pd.link import OutFrame, StateChannel
from eap.pd.spec import TxFrameSpec, TxPdSpec
from eap.pd.station import Station
from tests.support.cyclic import MS, eap_port, image_of, station, written


def test_a_frame_is_patched_in_slot_and_seen_through_its_view():
    buffer = bytearray(b"headerframe")
    frame = OutFrame(buffer, 6, "01:01:05:04:00:00")
    buffer[6:] = b"FRAME"
    assert bytes(frame.view[frame.headroom :]) == b"FRAME"
    assert frame.destination == "01:01:05:04:00:00"


def test_a_frame_is_of_a_good_size_until_a_channel_finds_otherwise():
    assert not OutFrame(bytearray(9), 0, "10.0.0.1").oversized


class Wire:
    """Keeps what is sent, behind four octets of its own."""

    minimum_size = 60
    direct = None

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def drain(self, now_ns: int) -> int:
        return now_ns

    def link_header(self, destination: str) -> bytes:
        return destination.encode()[:4]

    def exchange_handler(self, old, new) -> None:
        self.exchanged = old, new

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        self.sent += [bytes(frame.view[frame.headroom :]) for frame in frames]
        return frames[1:]


def _octets_of(*, eap_sm: bool) -> list[int]:
    frames = tuple(
        TxFrameSpec(f"f{n}", "eap0", f"02:00:00:00:00:0{n}", (TxPdSpec(f"p{n}", n, ("a",)),))
        for n in range(2)
    )
    port = replace(eap_port(), eap_sm=eap_sm)
    spec = station(variables=written("a:UINT"), frames=frames, ports=(port,))
    sender, wire = Station(spec, image_of(spec), lambda: None), Wire()
    sender.connect("eap0", wire)
    due_ns = sender.start(MS)
    sender.cycle(due_ns, due_ns)
    sender.cycle(due_ns + MS, due_ns + MS)
    assert [decode_frame_header(frame).cycle for frame in wire.sent] == [1, 1, 2, 2]
    return [decode_frame_header(frame).eap_sm for frame in wire.sent]


def test_frames_carry_state_and_a_toggle_when_the_port_says_so():
    assert _octets_of(eap_sm=True) == [0x28, 0x08, 0x28, 0x08]


def test_the_octet_is_zero_otherwise():
    assert _octets_of(eap_sm=False) == [0, 0, 0, 0]


def test_state_channel_delegates_to_channel():
    spec = station()
    image = image_of(spec)
    image.words[11] = DeviceState.SAFEOP
    wire = Wire()
    channel = StateChannel(wire, image.words)
    out = [OutFrame(bytearray(20), 4, "x"), OutFrame(bytearray(16), 0, "y")]
    assert channel.send(out, 5) == out[1:]
    assert [frame[13] for frame in wire.sent] == [0x24, 0x04]
    assert (channel.minimum_size, channel.link_header("abcdef"), channel.drain(7)) == (
        60,
        b"abcd",
        7,
    )
