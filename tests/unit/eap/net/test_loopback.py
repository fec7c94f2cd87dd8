"""The line in memory: delivery, times, and faults that repeat themselves."""

from __future__ import annotations

from itertools import pairwise

import pytest

from eap.errors import ConfigError
from eap.ids import InterfaceUri
from eap.net.loopback import DRAIN_LIMIT, HOLD_NS, LoopbackLines
from eap.pd.link import OutFrame


class Listener:
    """A port that notes what it takes."""

    def __init__(self, lines, uri="loop://line"):
        self.channel = lines.open(InterfaceUri.parse(uri))
        self.channel.handlers.append(self.take)
        self.got = []

    def take(self, data, size, at_ns, origin):
        self.got.append((bytes(data[:size]), at_ns))
        self.sender = origin.sender_of(data)

    def numbers(self):
        return [data[0] for data, _ in self.got]


def frame(number, headroom=0):
    return OutFrame(bytearray(headroom) + bytes([number, 0x40]), headroom, "127.0.0.1")


def run(options, count=200):
    """Send *count* frames 1 ms apart over a line with *options*; return their order of arrival."""
    lines = LoopbackLines()
    sender, receiver = Listener(lines, "loop://line" + options), Listener(lines)
    for n in range(count):
        sender.channel.send([frame(n)], n * 1_000_000)
        receiver.channel.drain(n * 1_000_000)
    receiver.channel.drain(count * 1_000_000 + HOLD_NS)
    return receiver.numbers()


def test_loopback_frame_reaches_all_other_ports():
    lines = LoopbackLines()
    first, second, third = (Listener(lines) for _ in range(3))
    stranger = Listener(lines, "loop://other")
    assert first.channel.send([frame(1), frame(2)], 500) == ()
    for port in (first, second, third, stranger):
        port.channel.drain(500)
    assert second.got == third.got == [(b"\x01\x40", 500), (b"\x02\x40", 500)]
    assert first.got == stranger.got == []


def test_loopback_copies_frame_without_headroom():
    lines = LoopbackLines()
    sender, receiver = Listener(lines), Listener(lines)
    out = frame(1, headroom=4)
    sender.channel.send([out], 0)
    out.view[4] = 9
    receiver.channel.drain(0)
    assert receiver.got == [(b"\x01\x40", 0)]


def test_delay_is_kept_to_the_nanosecond():
    lines = LoopbackLines()
    sender, receiver = Listener(lines, "loop://line?delay_us=250"), Listener(lines)
    sender.channel.send([frame(1)], 1000)
    assert receiver.channel.drain(250_999) == 0
    assert receiver.channel.drain(251_000) == 1
    assert receiver.got == [(b"\x01\x40", 251_000)]


def test_faults_are_those_of_the_port_that_sends():
    lines = LoopbackLines()
    faulty, sound = Listener(lines, "loop://line?loss=1"), Listener(lines)
    faulty.channel.send([frame(1)], 0)
    sound.channel.send([frame(2)], 0)
    faulty.channel.drain(0)
    sound.channel.drain(0)
    assert faulty.numbers() == [2]
    assert sound.numbers() == []


def test_sound_line_keeps_everything_in_order():
    assert run("") == list(range(200))


def test_loss_takes_its_share():
    got = run("?loss=0.25&seed=1")
    assert got == sorted(set(got))
    assert 130 <= len(got) <= 170


def test_duplicates_follow_their_original():
    got = run("?duplicate=0.25&seed=1")
    assert sorted(set(got)) == list(range(200))
    assert got == sorted(got)
    assert 230 <= len(got) <= 270


def test_reordered_frame_arrives_behind_the_next():
    got = run("?reorder=0.1&seed=1")
    assert sorted(got) == list(range(200))
    swapped = sum(first > second for first, second in pairwise(got))
    assert 8 <= swapped <= 30


def test_held_frame_arrives_though_none_overtakes_it():
    lines = LoopbackLines()
    sender, receiver = Listener(lines, "loop://line?reorder=1"), Listener(lines)
    sender.channel.send([frame(1)], 0)
    assert receiver.channel.drain(HOLD_NS - 1) == 0
    assert receiver.channel.drain(HOLD_NS) == 1


@pytest.mark.parametrize("options", ["?loss=0.3&duplicate=0.2&reorder=0.2&seed=7"])
def test_same_seed_same_run(options):
    assert run(options) == run(options)
    assert run(options) != run(options.replace("seed=7", "seed=8"))


def test_drain_is_bounded_and_the_rest_waits():
    lines = LoopbackLines()
    sender, receiver = Listener(lines), Listener(lines)
    sender.channel.send([frame(n % 256) for n in range(DRAIN_LIMIT + 5)], 0)
    assert receiver.channel.drain(0) == DRAIN_LIMIT
    assert receiver.channel.drain(0) == 5
    assert receiver.numbers() == [n % 256 for n in range(DRAIN_LIMIT + 5)]


def test_loopback_closed_port_receives_nothing():
    lines = LoopbackLines()
    sender, receiver = Listener(lines), Listener(lines)
    receiver.channel.close()
    sender.channel.send([frame(1)], 0)
    assert receiver.channel.drain(0) == 0


def test_loopback_has_no_headroom():
    channel = Listener(LoopbackLines()).channel
    assert channel.link_header("239.0.0.1") == b""
    assert channel.minimum_size == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("?latency=3", "unknown option 'latency'"),
        ("?loss=much", "loss is 'much', expected a number"),
        ("?loss=2", "loss is 2, expected 0 to 1"),
        ("?delay_us=-1", "delay_us is -1"),
        ("?reorder=nan", "reorder is nan"),
    ],
)
def test_wrong_option_is_named(options, message):
    with pytest.raises(ConfigError, match=message):
        LoopbackLines().open(InterfaceUri.parse("loop://line" + options))


def test_loopback_answer_reaches_requester_only():
    lines = LoopbackLines()
    asking, asked, third = (Listener(lines) for _ in range(3))
    asking.channel.send([frame(1)], 0)
    asked.channel.drain(0)
    answer = OutFrame(bytearray([2, 0x40]), 0, asked.sender)
    assert asked.channel.send([answer], 0) == ()
    third.channel.drain(0)
    asking.channel.drain(0)
    assert asking.numbers() == [2]
    assert third.numbers() == [1]
    asking.channel.close()
    asked.channel.send([answer], 0)
    third.channel.drain(0)
    assert third.numbers() == [1]
