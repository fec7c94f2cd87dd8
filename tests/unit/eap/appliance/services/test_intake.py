"""Frames that services does not take, by reason."""

from __future__ import annotations

import asyncio
import select
import socket
import time
from time import monotonic_ns

import pytest

from eap.appliance.discards import DiscardCounters, Refusal
from eap.appliance.services.intake import FrameIntake, watch_channel
from eap.codec.ethercat import EtherCatHeader
from eap.net.mmsg import ReceiveBatch
from eap.net.udp import UdpChannel
from eap.net.udpsocket import prepare_receiver
from tests.support.cyclic import From

MAILBOX = memoryview(EtherCatHeader(6, 0, 5).encode() + bytes(6))
NOBODY = From()
UNKNOWN = memoryview(EtherCatHeader(0, 0, 7).encode())


@pytest.fixture
def counters(tmp_path):
    with DiscardCounters(tmp_path / "discards", ["a", "b"]) as counters:
        yield counters


def refuse(data, size, at_ns, origin) -> Refusal | None:
    return Refusal.MAILBOX


def test_each_frame_is_counted_once_at_every_station(counters):
    intake = FrameIntake(["a", "b"], counters, 100, refuse)
    intake.take(MAILBOX, 8, 99, NOBODY)
    intake.take(MAILBOX, 8, 100, NOBODY)
    intake.take(MAILBOX, 8, 101, NOBODY)
    intake.take(UNKNOWN, 2, 100, NOBODY)
    intake.take(UNKNOWN, 1, 100, NOBODY)
    expected = {"mailbox": 2, "stale": 1, "wrong_type": 1, "truncated": 1}
    assert counters.stats() == {"a": expected, "b": expected}


def test_what_is_taken_is_not_counted(counters):
    taken = []
    intake = FrameIntake(["a", "b"], counters, 100, lambda *frame: taken.append(frame))
    intake.take(MAILBOX, 8, 99, NOBODY)
    intake.take(MAILBOX, 8, 100, NOBODY)
    intake.take(UNKNOWN, 2, 100, NOBODY)
    assert taken == [(MAILBOX, 8, 100, NOBODY)]
    assert counters.stats()["a"] == {"stale": 1, "wrong_type": 1}


@pytest.mark.net
def test_a_socket_is_drained_at_once_and_on_arrival(counters):
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        prepare_receiver(receiver)
        time.sleep(0.1)  # the first one on a machine that asks: the kernel begins to stamp later
        receiver.bind(("127.0.0.1", 0))
        sender.connect(receiver.getsockname())
        sender.send(MAILBOX)
        assert select.select([receiver], [], [], 5)[0]  # a busy kernel delivers later

        async def serve():
            # The kernel stamps on another clock, and the two are compared to microseconds only.
            await asyncio.sleep(0.01)
            intake = FrameIntake(["a"], counters, monotonic_ns(), refuse)
            watch_channel(UdpChannel(receiver, ReceiveBatch(), [intake.take]))
            assert counters.stats()["a"] == {"stale": 1}
            sender.send(MAILBOX)
            async with asyncio.timeout(5):
                while "mailbox" not in counters.stats()["a"]:  # noqa: ASYNC110  it is a file
                    await asyncio.sleep(0.001)

        asyncio.run(serve())
    assert counters.stats()["a"] == {"stale": 1, "mailbox": 1}
