from __future__ import annotations

import pytest

from devicebus.master.access import DatagramReply
from devicebus.master.look import look_around
from devicebus.master.mailboxes import Unsolicited
from devicebus.master.master import Master
from devicebus.master.procedure import StepReplies
from devicebus.wire.alstatus import AlState
from eap.codec.mailbox import MailboxType
from tests.support.busline import MS, Line, segment, slave


class Teller:
    """A protocol of a slave that has something to say."""

    def __init__(self):
        self.news = []

    def receive_message(self, data, now_ns):
        del now_ns
        return [data]

    def messages_to_send(self, now_ns):
        del now_ns
        news, self.news = self.news, []
        return news

    def reset(self):
        pass


@pytest.fixture
def line():
    line = Line(Master(), segment(*(slave(f"s{n}") for n in range(17)), slave("x", mailbox=None)))
    line.wait(line.core.bring_up(line.now_ns, AlState.PREOP))
    line.tellers = []
    for device in line.segment.slaves[:17]:
        line.tellers.append(Teller())
        device.device.mailbox.protocols[MailboxType.VOE] = line.tellers[-1]
    line.elapse(30 * MS)
    return line


def heard(line):
    events = iter(line.core.next_event, None)
    return [(each.station, each.data) for each in events if isinstance(each, Unsolicited)]


def test_all_that_is_said_is_heard(line):
    for number in (0, 3, 16):
        line.tellers[number].news = [b"first", b"second"]
    line.elapse(30 * MS)
    assert sorted(heard(line)) == [
        (1001 + number, text) for number in (0, 3, 16) for text in (b"first", b"second")
    ]


def test_a_look_at_seventeen_takes_two_frames(line):
    looking = look_around(line.core._bus)
    assert len(next(looking)) == 15
    assert len(looking.send(StepReplies([DatagramReply(b"\0", 1)] * 15, 0))) == 2


def test_a_look_that_is_lost_is_made_again(line):
    line.tellers[0].news = [b"here"]
    first = line.frames
    line.lose_back = lambda number: number < first + 6
    line.elapse(400 * MS)
    assert heard(line) == [(1001, b"here")]
