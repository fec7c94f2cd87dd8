"""A simulated segment given any frames, and its slaves given any mailbox messages."""

from __future__ import annotations

from devicebus.sim.devices.build import build_segment
from devicebus.sim.slave import SimulatedSlave
from devicebus.sim.spec import (
    BusSpec,
    ChannelSpec,
    ClockSpec,
    DeviceKind,
    FileSpec,
    MailboxSpec,
    SlaveSpec,
)
from devicebus.wire.alstatus import AlState
from devicebus.wire.register import Register, SyncManager
from eap.codec.mailbox import MailboxHeader, MailboxType, encode_message
from tools.fuzz.messages import cut

MAILBOX = MailboxSpec(size=64, foe=True, soe=True, eoe=True, voe=True, aoe=True)
_START = 0x1000
_STEP_NS = 700_000
_MAX_ANSWERS = 40
_CHANNELS = SyncManager(_START, 64, 2, 1, enable=1), SyncManager(_START + 64, 64, 2, 0, enable=1)

_KINDS = tuple(MailboxType)
_SEGMENT = build_segment(
    BusSpec(
        bus="fuzz",
        slaves=(
            SlaveSpec(
                name="drive",
                kind=DeviceKind.DRIVE,
                axes=2,
                mailbox=MAILBOX,
                files=(FileSpec(name="a", max_size=100),),
            ),
            SlaveSpec(
                name="simple",
                kind=DeviceKind.DIGITAL,
                mailbox=None,
                clock=ClockSpec(drift_ppm=50),
                inputs=tuple(ChannelSpec(name=f"i{n}", follows="o") for n in range(3)),
                outputs=(ChannelSpec(name="o"),),
            ),
        ),
        ring=True,
    )
)


def fuzz_one(data: bytes) -> None:
    """Let the octets pass as frames, then read them as messages; nothing may be raised."""
    drive = _SEGMENT.slaves[0]
    for number in range(len(_SEGMENT.slaves)):
        _SEGMENT.switch(number, on=False)
        _SEGMENT.switch(number, on=True)
    _open_mailbox(drive)
    now_ns = 0
    for octets in (data, *cut(data)):
        frame = bytearray(octets)
        _SEGMENT.process_frame(frame, now_ns)
        if len(frame) != len(octets):
            raise AssertionError(f"{len(octets)} octets went in, {len(frame)} came out")
        now_ns += _STEP_NS
    for number, octets in enumerate(cut(data)):
        for message in (octets, _with_header(octets, number)):
            drive.esc.write(_START, message[:64].ljust(64, b"\0"), now_ns)
            _fetch(drive, now_ns)
            now_ns += _STEP_NS


def _with_header(octets: bytes, number: int) -> bytes:
    """Make a message whose header fits; its type is in the first octet."""
    kind, body = (octets[0] & 0x0F, octets[1:]) if octets else (3, b"")
    return encode_message(MailboxHeader(0, type=_KINDS[kind % len(_KINDS)], counter=number % 8),
                          body)  # fmt: skip


def _open_mailbox(slave: SimulatedSlave) -> None:
    for number, channel in enumerate(_CHANNELS):
        slave.esc.write(Register.SYNC_MANAGER + 8 * number, channel.encode(), 0)
    slave.esc.write(Register.AL_CONTROL, AlState.PREOP.to_bytes(2, "little"), 0)
    slave.run(0)


def _fetch(slave: SimulatedSlave, now_ns: int) -> None:
    """Read what a slave has to say; it must come to an end."""
    for _ in range(_MAX_ANSWERS):
        slave.run(now_ns)
        if slave.esc.read(_START + 64, 64, now_ns) is None:
            return
    if slave.esc.channels[1].is_enabled:
        raise AssertionError(f"{_MAX_ANSWERS} answers to one message")
