"""Slaves that go and come back, and the others that notice nothing."""

from __future__ import annotations

import pytest

from devicebus.master.bus import (
    BusBack,
    BusLost,
    MasterSettings,
    SlaveBack,
    SlaveFailed,
    SlaveLeft,
)
from devicebus.master.mailboxes import Unsolicited
from devicebus.master.master import Master
from devicebus.master.procedure import StepReplies
from devicebus.master.watch import ErrorPeriod, PortErrorLog, poll_mailboxes
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import Command, DatagramReply
from eap.codec.mailbox import MailboxType
from tests.support.busline import MS, Line, Paced, accesses_of, segment, slave


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
def paced():
    paced = Line(Master(), segment(*(slave(f"s{n}") for n in range(17)), slave("x", mailbox=None)))
    paced.wait(paced.core.bring_up(paced.now_ns, AlState.PREOP))
    paced.tellers = []
    for device in paced.segment.slaves[:17]:
        paced.tellers.append(Teller())
        device.device.mailbox.protocols[MailboxType.VOE] = paced.tellers[-1]
    paced.elapse(30 * MS)
    return paced


def unsolicited(paced):
    events = iter(paced.core.next_event, None)
    return [(each.station, each.data) for each in events if isinstance(each, Unsolicited)]


def test_poll_mailboxes_reports_all_messages(paced):
    for number in (0, 3, 16):
        paced.tellers[number].news = [b"first", b"second"]
    paced.elapse(30 * MS)
    assert sorted(unsolicited(paced)) == [
        (1001 + number, text) for number in (0, 3, 16) for text in (b"first", b"second")
    ]


def test_poll_mailboxes_of_17_slaves_takes_two_frames(paced):
    looking = poll_mailboxes(paced.core._open_mailboxes())
    assert len(next(looking)) == 15
    assert len(looking.send(StepReplies([DatagramReply(b"\0", 1)] * 15, 0))) == 2


def test_poll_mailboxes_lost_frame_is_polled_again(paced):
    paced.tellers[0].news = [b"here"]
    first = paced.frames
    paced.lose_back = lambda number: number < first + 6
    paced.elapse(400 * MS)
    assert unsolicited(paced) == [(1001, b"here")]


def counters(**at):
    octets = bytearray(0x14)
    for name, count in at.items():
        octets[{"crc0": 0, "rx1": 3, "forwarded2": 10, "lost3": 19}[name]] = count
    return bytes(octets)


def test_port_error_log_first_poll_has_no_times():
    log = PortErrorLog()
    log.take(1001, counters(crc0=7), 5)
    assert log.of(1001) == {}


def test_port_error_log_notes_first_and_last_growth_of_each_port():
    log = PortErrorLog()
    for now_ns, octets in (
        (5, counters()),
        (6, counters(crc0=1)),
        (7, counters(crc0=1, lost3=1)),
        (8, counters(crc0=3, lost3=1, forwarded2=9)),
        (9, counters(crc0=3, lost3=1, forwarded2=9)),
    ):
        log.take(1001, octets, now_ns)
    assert log.of(1001) == {0: ErrorPeriod(6, 8), 3: ErrorPeriod(7, 7)}


def test_port_error_log_counters_that_were_cleared_end_older_times():
    log = PortErrorLog()
    for now_ns, octets in ((5, counters()), (6, counters(crc0=1)), (7, counters())):
        log.take(1001, octets, now_ns)
    assert log.of(1001) == {}
    log.take(1001, counters(rx1=2), 8)
    assert log.of(1001) == {1: ErrorPeriod(8, 8)}


def test_port_error_log_clear_drops_all_times():
    log = PortErrorLog()
    for now_ns in (5, 6):
        log.take(1001, counters(crc0=now_ns), now_ns)
    log.clear()
    assert log.of(1001) == {}
    log.take(1001, counters(crc0=6), 7)
    assert log.of(1001) == {}


def test_master_reads_error_counters_once_a_second_while_cycles_run():
    line = Paced(Master(), segment(slave("a"), slave("b")))
    line.wait(line.core.bring_up(line.now_ns))
    line.elapse(1_100 * MS)
    line.segment.slaves[1].esc.memory[0x0300] = 4
    begun_ns = line.now_ns
    line.elapse(1_100 * MS)
    (seen,) = line.core.port_errors.of(1002).values()
    assert seen.since_ns == seen.until_ns
    assert 0 < seen.until_ns - begun_ns < 1_010 * MS
    assert line.core.port_errors.of(1001) == {}


@pytest.fixture
def line():
    line = Paced(
        Master(),
        segment(
            slave("a", serial=1),
            slave("branch", serial=2, after="a", port=3),
            slave("b", serial=3, after="a"),
            slave("c", serial=4),
        ),
    )
    line.wait(line.core.bring_up(line.now_ns))
    line.elapse(20 * MS)
    assert line.events() == []
    return line


def kinds(events):
    return [(type(each).__name__, each.station) for each in events]


def by_name(line):
    return {each.device.name: each for each in line.segment.slaves}


def test_watch_slave_that_leaves_op_is_brought_back(line):
    by_name(line)["b"].fail(0x1A)
    begun = line.now_ns
    line.elapse(130 * MS)
    left, back = line.events()
    assert (left.station, left.status, left.code) == (1003, 0x14, 0x1A)
    assert kinds([left, back]) == [("SlaveLeft", 1003), ("SlaveBack", 1003)]
    assert back.at_ns - begun < 120 * MS
    assert by_name(line)["b"].state is AlState.OP
    assert line.core.stats().cycle.wkc_errors == 0


def test_watch_slave_without_power_gets_its_address_back(line):
    line.segment.switch(1, on=False)
    line.elapse(30 * MS)
    assert kinds(line.events()) == [("SlaveLost", 1002)]
    assert line.core.slaves[1002].mailbox is None
    errors = line.core.stats().cycle.wkc_errors
    assert 1 <= errors <= 10
    cycles = line.core.stats().cycle.good
    line.elapse(200 * MS)
    assert line.core.stats().cycle.good - cycles == 200
    line.segment.switch(1, on=True)
    begun = line.now_ns
    line.elapse(150 * MS)
    (back,) = line.events()
    assert kinds([back]) == [("SlaveBack", 1002)]
    assert back.at_ns - begun < 130 * MS
    assert {each.state for each in line.segment.slaves} == {AlState.OP}
    assert line.core.stats().cycle.wkc_errors == errors
    assert line.core.slaves[1002].mailbox is not None


def test_watch_slaves_behind_a_cut_come_back(line):
    line.segment.cut(2)
    line.elapse(500 * MS)
    assert set(kinds(line.events())) == {("SlaveLost", 1003), ("SlaveLost", 1004)}
    errors = line.core.stats().cycle.wkc_errors
    line.segment.mend(2)
    line.elapse(200 * MS)
    assert line.core.stats().cycle.wkc_errors == errors
    assert set(kinds(line.events())) == {("SlaveBack", 1003), ("SlaveBack", 1004)}
    assert {each.state for each in line.segment.slaves} == {AlState.OP}


def test_watch_two_slaves_get_their_own_addresses_back(line):
    for number in (1, 3):
        line.segment.switch(number, on=False)
    line.elapse(50 * MS)
    for number in (3, 1):
        line.segment.switch(number, on=True)
    line.elapse(300 * MS)
    assert {each.state for each in line.segment.slaves} == {AlState.OP}
    stations = {name: each.esc.station for name, each in by_name(line).items()}
    assert stations == {"a": 1001, "branch": 1002, "b": 1003, "c": 1004}


def test_watch_failing_slave_is_retried_each_second(line):
    line.period_ns = 4 * MS
    slave_b = by_name(line)["b"]
    slave_b.refused_states[AlState.OP] = 0x1A
    slave_b.fail(0x1A)
    line.elapse(2500 * MS)
    events = line.events()
    assert isinstance(events[0], SlaveLeft)
    failures = [each for each in events if isinstance(each, SlaveFailed)]
    assert len(events) == 1 + len(failures)
    assert 2 <= len(failures) <= 3
    assert "refuses OP" in failures[0].reason
    slave_b.refused_states.clear()
    line.elapse(1500 * MS)
    assert kinds(line.events()) == [("SlaveBack", 1003)]


def test_watch_other_slave_at_the_position_is_refused(line):
    line.segment.switch(3, on=False)
    line.elapse(50 * MS)
    line.events()
    image = line.segment.slaves[3].esc.image
    line.segment.slaves[3].esc.image = image[:28] + b"\x63" + image[29:]
    line.segment.switch(3, on=True)
    line.elapse(300 * MS)
    (failed,) = line.events()
    assert isinstance(failed, SlaveFailed)
    assert "in place of c (station 1004) there is vendor" in failed.reason
    assert "serial 99" in failed.reason
    assert by_name(line)["b"].state is AlState.OP


def test_watch_with_a_cut_first_cable_reports_the_bus_and_no_slave(line):
    line.segment.cut(0)
    line.elapse(300 * MS)
    assert line.core.is_lost
    (lost,) = line.events()
    assert isinstance(lost, BusLost)
    line.segment.mend(0)
    line.elapse(500 * MS)
    events = line.events()
    assert isinstance(events[0], BusBack)
    assert not line.core.is_lost
    # Without outputs their watchdogs have brought them to SAFEOP.
    assert {(each.status, each.code) for each in events if isinstance(each, SlaveLeft)} == {
        (0x14, 0x1B)
    }
    assert len([each for each in events if isinstance(each, SlaveBack)]) == 4
    assert {each.state for each in line.segment.slaves} == {AlState.OP}


def test_watch_with_a_short_silence_changes_nothing(line):
    line.period_ns = 4 * MS
    mailboxes = [unit.mailbox for unit in line.core.slaves.values()]
    for _ in range(10):
        line.lose_back = lambda _: True
        line.elapse(60 * MS)
        line.lose_back = lambda _: False
        line.elapse(240 * MS)
    assert line.events() == []
    assert [unit.mailbox for unit in line.core.slaves.values()] == mailboxes
    assert {each.state for each in line.segment.slaves} == {AlState.OP}


def test_watch_slave_is_lost_until_it_is_configured_again(line):
    unit = line.core.slaves[1003]
    line.segment.switch(2, on=False)
    line.elapse(50 * MS)
    line.segment.switch(2, on=True)
    shown = []
    while unit.missing_since_ns is not None:
        line.step(line.now_ns + MS)
        state = 0 if unit.is_lost else int(unit.state)
        assert state == 0 or (unit.mailbox is not None) is (state > AlState.INIT)
        if not shown or shown[-1] != state:
            shown.append(state)
    assert shown == [0, 1, 2, 4, 8]


@pytest.mark.parametrize("silent_ms", [12, 400])
def test_watch_return_interrupted_by_a_silent_bus_reopens_the_mailbox(line, silent_ms):
    line.period_ns = 4 * MS
    unit = line.core.slaves[1003]
    slave_b = by_name(line)["b"]
    for frames in range(1, 40, 9):  # the bus falls silent at another step each time
        line.segment.switch(2, on=False)
        line.elapse(40 * MS)
        line.segment.switch(2, on=True)
        while not unit.is_busy:
            line.step(line.now_ns + MS)
        first = line.frames + frames
        line.lose_out = lambda number, first=first: number >= first
        line.elapse(silent_ms * MS)
        line.lose_out = lambda number: False
        line.elapse(1300 * MS)
        assert (unit.is_lost, unit.state, slave_b.state) == (False, AlState.OP, AlState.OP)
        assert unit.mailbox is not None


def test_watch_lost_reference_clock_is_not_distributed():
    line = Paced(
        Master(MasterSettings(clocks=True)),
        segment(
            slave("none", clock=None), slave("a", after="none", port=3), slave("b", after="none")
        ),
    )
    line.wait(line.core.bring_up(line.now_ns))
    line.segment.switch(1, on=False)
    line.elapse(50 * MS)
    sent = []
    keep = line.core.frames_to_send
    line.core.frames_to_send = lambda now: [sent.append(each) or each for each in keep(now)]
    line.elapse(50 * MS)
    commands = {access.command for frame in sent for access in accesses_of(frame)}
    assert Command.LRW in commands
    assert Command.FRMW not in commands
    line.segment.switch(1, on=True)
    line.elapse(300 * MS)
    commands = {access.command for frame in sent for access in accesses_of(frame)}
    assert Command.FRMW in commands
    assert {each.state for each in line.segment.slaves} == {AlState.OP}
