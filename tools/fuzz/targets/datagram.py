"""Frames of type 1: walked, passed by simulated slaves, and taken by a master that waits."""

from __future__ import annotations

from devicebus.master.link import Link
from devicebus.sim.devices.build import build_segment
from devicebus.sim.spec import BusSpec, ChannelSpec, DeviceKind, SlaveSpec
from devicebus.wire.datagram import Command, encode_frame, fprd, iter_datagrams, logical
from eap.errors import CodecError

_BIT = (ChannelSpec(name="bit"),)
_BUS = BusSpec(
    bus="fuzzed",
    slaves=(
        SlaveSpec(name="coupler", kind=DeviceKind.COUPLER),
        SlaveSpec(name="digital", kind=DeviceKind.DIGITAL, inputs=_BIT, outputs=_BIT),
    ),
)


def fuzz_one(data: bytes) -> None:
    """Read every datagram and write the frame again; only CodecError may pass."""
    _pass_slaves(data)
    _answer(data)
    try:
        datagrams = list(iter_datagrams(data))
    except CodecError:
        return
    again = encode_frame(datagrams)
    if again[2:] != data[2 : len(again)]:
        raise AssertionError("the datagrams encode to other octets")


def _pass_slaves(data: bytes) -> None:
    segment = build_segment(_BUS)
    frame = bytearray(data)
    for now_ns in (0, 1_000_000):
        segment.process_frame(frame, now_ns)
        segment.handle_timeout(now_ns)
    if len(frame) != len(data):
        raise AssertionError(f"{len(frame)} octets came back of {len(data)}")


def _answer(data: bytes) -> None:
    """Whatever comes back, each request is answered once: by a frame, or by its loss."""
    answers: list[object] = []
    link = Link(ceiling_ns=4_000_000, retries=2)
    accesses = [fprd(1001, 0x130, 6), logical(Command.LRW, 0x10000, bytes(4))]
    link.submit(accesses, lambda outcome, _: answers.append(outcome))
    (sent,) = link.frames_to_send(0)
    cut = data[0] % len(sent) if data else 0
    for octets in (data, sent[:cut] + data[1:], sent[: len(sent) - cut]):
        link.receive_frame(octets, 1)
    for now_ns in range(0, 50_000_000, 5_000_000):
        link.handle_timeout(now_ns)
        link.frames_to_send(now_ns)
    if len(answers) != 1:
        raise AssertionError(f"{len(answers)} answers to one request")
