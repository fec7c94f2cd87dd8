"""Frames of type 5: what is taken, and how packets are packed."""

from __future__ import annotations

import pytest

from eap.runtime.drop_counters import DropReason
from eap.services.transports import mailbox_frames
from eap.services.transports.mailbox_frames import (
    FrameCounters,
    aoe_packet,
    refusal_of,
)
from tests.support import aoe

PACKET = aoe.packet("1.1.1.1.2.1", 4, b"abc")


@pytest.mark.parametrize("frame", [aoe.frame(PACKET), aoe.frame(PACKET, counter=0) + bytes(9)])
def test_aoe_packet_accepts_aoe_to_address_0(frame):
    assert aoe_packet(frame) == PACKET


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (aoe.frame(PACKET, address=1001), DropReason.MAILBOX),
        (aoe.frame(PACKET, kind=3), DropReason.MAILBOX),
        (aoe.frame(PACKET, kind=9), DropReason.MAILBOX),
        (aoe.frame(PACKET)[:-1], DropReason.TRUNCATED),
        (aoe.frame(b"too short"), DropReason.MAILBOX),
        (b"\x00\x50", DropReason.TRUNCATED),
    ],
)
def test_aoe_packet_rejects_other_frames(frame, reason):
    assert aoe_packet(frame) is None
    assert refusal_of(frame) is reason


def test_each_peer_gets_its_own_counter(monkeypatch):
    monkeypatch.setattr(mailbox_frames, "_MAX_PEERS", 2)
    counters = FrameCounters()
    peers = ["a"] * 8 + ["b", "a", "c", "a", "b"]
    frames = [counters.frame(peer, PACKET) for peer in peers]
    assert [each[7] >> 4 for each in frames] == [1, 2, 3, 4, 5, 6, 7, 1, 1, 2, 1, 3, 1]
    assert {aoe.opened(each) for each in frames} == {PACKET}
