"""Ring and trigger of a recording, without a plant."""

from __future__ import annotations

import zlib

from eap.recording.capture import CapturedBlock
from eap.recording.ring import BlockRing, RecordingTrigger, TriggerAction

S = 1_000_000_000


def ring(length_s: int, **limits: int) -> BlockRing:
    return BlockRing(length_s * S, zlib.compress, zlib.decompress, **limits)


def block(second: float, data: bytes = b"x" * 5000) -> CapturedBlock:
    return CapturedBlock("a", int(second * S), int(second * S) + S // 2, data)


def test_ring_keeps_the_last_seconds_and_compresses_them():
    kept = ring(3)
    for second in range(10):
        kept.add(block(second))
    assert [each.first_ns // S for each in kept.since(0)] == [6, 7, 8, 9]
    assert {each.data for each in kept.since(0)} == {b"x" * 5000}
    assert kept.size < 1000
    assert kept.held_ns == 3.5 * S
    assert not kept.is_cut


def test_ring_gives_the_blocks_that_reach_into_the_wanted_time():
    kept = ring(60)
    for second in range(10):
        kept.add(block(second))
    assert [each.first_ns // S for each in kept.since(7 * S + 1)] == [7, 8, 9]


def test_ring_without_room_drops_the_oldest_and_says_so():
    kept = ring(60, limit=3000)
    for second in range(10):
        kept.add(block(second, bytes([second]) * 1000))
    assert [each.data[0] for each in kept.since(0)] == [7, 8, 9]
    assert kept.is_cut
    kept.clear()
    assert (kept.size, kept.held_ns, list(kept.since(0))) == (0, 0, [])


def test_trigger_opens_when_the_condition_becomes_true_and_closes_after_its_time():
    trigger = RecordingTrigger(20 * S, 10 * S)
    assert trigger.update(1 * S, is_true=False) is None
    assert trigger.update(2 * S, is_true=True) is TriggerAction.OPEN
    assert trigger.update(3 * S, is_true=True) is None
    assert trigger.handle_time(12 * S) is None
    assert trigger.handle_time(12 * S + 1) is TriggerAction.CLOSE
    # It is still true: only another change to true is an event.
    assert trigger.update(13 * S, is_true=True) is None
    assert trigger.update(14 * S, is_true=False) is None
    assert trigger.update(15 * S, is_true=True) is TriggerAction.OPEN
    assert trigger.count == 2


def test_trigger_that_comes_again_extends_the_file():
    trigger = RecordingTrigger(20 * S, 10 * S)
    trigger.update(2 * S, is_true=True)
    trigger.update(3 * S, is_true=False)
    assert trigger.update(9 * S, is_true=True) is TriggerAction.MARK
    assert trigger.handle_time(13 * S) is None
    assert trigger.handle_time(19 * S + 1) is TriggerAction.CLOSE


def test_trigger_is_forgotten_with_its_plant():
    trigger = RecordingTrigger(20 * S, 10 * S)
    trigger.update(2 * S, is_true=True)
    trigger.reset()
    assert not trigger.is_recording
    assert trigger.handle_time(99 * S) is None
    assert trigger.update(100 * S, is_true=True) is TriggerAction.OPEN
