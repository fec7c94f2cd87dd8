from __future__ import annotations

import pytest

from devicebus.master.bus import BusLost, SlaveBack, SlaveFailed, SlaveLeft, SlaveLost
from devicebus.master.mailboxes import Unsolicited
from eap.codec.mailbox import MailboxType
from eap.engine.engine_bus import FaultCounts, SlaveFaults


class Master:
    def __init__(self, *events):
        self._events = list(events)

    def next_event(self):
        return self._events.pop(0) if self._events else None


@pytest.mark.parametrize(
    ("event", "text"),
    [
        (SlaveLost(1001, 1), "it does not answer"),
        (SlaveFailed(1001, "it refuses", 1), "it refuses"),
        (
            SlaveLeft(1001, 0x14, 0x1B, 1),
            "it went to SAFEOP+ERROR by itself: AL status code 0x001B, sync manager watchdog",
        ),
        (SlaveLeft(1001, 0x01, 0, 1), "it went to INIT by itself"),
        (BusLost(1), ""),
    ],
)
def test_bus_faults_have_texts(event, text):
    faults = SlaveFaults()
    faults.handle_events(Master(event))
    assert faults.of(1001) == text
    assert faults.of(1002) == ""


def test_the_last_counts_until_the_slave_is_back():
    faults = SlaveFaults()
    faults.handle_events(Master(SlaveLost(1001, 1), SlaveLost(1002, 1), SlaveFailed(1001, "x", 2)))
    assert (faults.of(1001), faults.of(1002)) == ("x", "it does not answer")
    faults.handle_events(Master(SlaveBack(1001, 1, 3)))
    assert (faults.of(1001), faults.of(1002)) == ("", "it does not answer")


def test_bus_faults_that_ended_are_counted():
    faults = SlaveFaults()
    faults.handle_events(
        Master(
            SlaveLost(1001, 1),
            SlaveBack(1001, 1, 2),
            SlaveLeft(1001, 0x14, 0x1B, 3),
            SlaveLeft(1001, 0x01, 0, 4),
            SlaveLost(1001, 5),
            BusLost(6),
        )
    )
    assert faults.counts(1001) == FaultCounts(losses=2, departures=2, al_code=0x1B)
    assert faults.counts(1002) == FaultCounts()


def test_unsolicited_messages_are_forwarded():
    faults, heard = SlaveFaults(), []
    faults.on_unsolicited.append(heard.append)
    message = Unsolicited(1001, MailboxType.EOE, b"frame")
    faults.handle_events(Master(message, SlaveLost(1001, 1)))
    assert heard == [message]
    assert faults.of(1001) == "it does not answer"


def test_slave_faults_silence_after_another_fault_has_its_own_start():
    faults = SlaveFaults()
    faults.handle_events(Master(SlaveFailed(1001, "it refuses", 1), SlaveLost(1001, 7)))
    assert faults.last(1001).since_ns == 7
    faults.handle_events(Master(SlaveLost(1001, 9), SlaveFailed(1001, "it refuses", 11)))
    assert faults.last(1001).since_ns == 7
