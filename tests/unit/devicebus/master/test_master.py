"""The master against a simulated segment: process data and mailboxes at once, under loss."""

from __future__ import annotations

import random

import pytest

from devicebus.errors import BusError
from devicebus.mailbox import coe_client, foe_client
from devicebus.master.bus import MasterSettings
from devicebus.master.master import Master
from devicebus.sim.spec import FileSpec, MailboxSpec
from devicebus.wire.alstatus import AlState
from tests.support.busline import MS, Paced, segment, slave

VENDOR = b"\x5a\x0e\0\0"


def line_of(*slaves, **settings):
    line = Paced(Master(MasterSettings(**settings)), segment(*slaves))
    line.wait(line.core.bring_up(line.now_ns))
    return line


def names(count):
    return [
        slave(f"s{n}", mailbox=MailboxSpec(foe=True), files=(FileSpec(name="f"),))
        for n in range(count)
    ]


@pytest.mark.parametrize("allow_lrw", [True, False])
def test_outputs_and_inputs_by_name(allow_lrw):
    line = line_of(*names(3), allow_lrw=allow_lrw)
    master = line.core
    master.image.write(1002, "out", True)
    line.segment.slaves[2].device.dictionary.entry(0x6000, 1).value = True
    line.elapse(5 * MS)
    values = [each.device.dictionary.entry(0x7000, 1).value for each in line.segment.slaves]
    assert values == [False, True, False]
    assert [master.image.read(1001 + n, "in") for n in range(3)] == [False, False, True]
    stats = master.stats().cycle
    assert stats.wkc_errors == stats.lost == 0
    assert stats.good > 5
    assert stats.received_wkc == stats.expected_wkc == (9 if allow_lrw else 6)


def test_mailboxes_never_delay_a_cycle():
    line = line_of(*names(8))
    master = line.core
    content = bytes(range(256)) * 64
    sizes = master.slaves[1001].mailbox.sizes
    at = 0

    def give(size):
        nonlocal at
        piece, at = content[at : at + size], at + size
        return piece

    file = master.converse(1001, foe_client.write("f", give, sizes), line.now_ns)
    before = master.stats().cycle
    begun = line.now_ns
    rounds = 0
    while not file.is_done:
        tasks = [
            master.converse(1001 + n, coe_client.upload(0x1018, 1), line.now_ns, requester="sdo")
            for n in range(8)
        ]
        assert [line.wait(task) for task in tasks] == [VENDOR] * 8
        rounds += 1
    file.result()
    stats = master.stats()
    passed = (line.now_ns - begun) // MS
    assert rounds > 5
    assert stats.cycle.cycles - before.cycles >= passed - 1
    assert stats.cycle.good - before.good == stats.cycle.cycles - before.cycles
    assert stats.cycle.max_trip_ns < 100_000
    assert stats.mailboxes[1001].timeouts == 0


@pytest.mark.parametrize("seed", range(3))
def test_process_data_and_mailboxes_under_loss(seed):
    line = line_of(*names(4))
    master = line.core
    dice = random.Random(seed)
    line.lose_out = lambda _: dice.random() < 0.02
    line.lose_back = lambda _: dice.random() < 0.02
    for number in range(40):
        tasks = [
            master.converse(1001 + n, coe_client.upload(0x1018, 1), line.now_ns) for n in range(4)
        ]
        master.image.write(1001 + number % 4, "out", True)
        assert [line.wait(task) for task in tasks] == [VENDOR] * 4
    line.lose_out = line.lose_back = lambda _: False
    line.elapse(1200 * MS)  # until the last lost frame counts as lost
    assert {each.state for each in line.segment.slaves} == {AlState.OP}
    stats = master.stats()
    assert stats.cycle.wkc_errors == 0
    assert stats.cycle.lost > 0
    assert stats.link.lost >= stats.cycle.lost
    assert all(each.device.dictionary.entry(0x7000, 1).value for each in line.segment.slaves)


def test_unsolicited_messages_are_events():
    line = line_of(*names(1))
    mailbox = line.segment.slaves[0].device.mailbox
    mailbox._enqueue(3, b"\x00\x10" + bytes(8), 0)
    line.elapse(30 * MS)
    (event,) = line.events()
    assert (event.station, event.data) == (1001, b"\x00\x10" + bytes(8))


def test_master_names_unknown_slaves_and_closed_mailboxes():
    line = line_of(slave("plain", mailbox=None), slave("a"))
    master = line.core
    with pytest.raises(BusError, match="unknown slave 1009; known slaves: 1001, 1002"):
        master.converse(1009, coe_client.upload(0x1018, 1), line.now_ns)
    with pytest.raises(BusError, match=r"slave 1001 \(plain\) has no mailbox: its EEPROM"):
        master.converse(1001, coe_client.upload(0x1018, 1), line.now_ns)
    line.segment.switch(1, on=False)
    line.elapse(300 * MS)
    with pytest.raises(BusError, match=r"slave 1002 \(a\) does not answer"):
        master.converse(1002, coe_client.upload(0x1018, 1), line.now_ns)


def test_master_requests_one_state_at_a_time_and_keeps_it():
    line = line_of(slave("a"), slave("b"))
    master = line.core
    going = master.request_state(1001, AlState.PREOP, line.now_ns)
    with pytest.raises(BusError, match="slave 1001 is being brought to PREOP already"):
        master.request_state(1001, AlState.OP, line.now_ns)
    line.wait(going)
    line.elapse(300 * MS)
    assert [each.state for each in line.segment.slaves] == [AlState.PREOP, AlState.OP]
    assert line.core.stats().cycle.wkc_errors == 0
    line.wait(master.request_state(1001, AlState.OP, line.now_ns))
    assert line.segment.slaves[0].state is AlState.OP
    assert line.events() == []


def test_master_without_a_bus_has_no_timers():
    master = Master()
    assert (master.next_timeout(), master.image, master.next_event()) == (None, None, None)
    master.start_cycle(0)
    master.stop_cycles()
    master.handle_timeout(0)
    assert master.frames_to_send(0) == []
    assert (master.stats().cycle, master.stats().mailboxes) == (None, {})
    with pytest.raises(BusError, match="known slaves: none"):
        master.request_state(1, AlState.OP, 0)
    master.receive_frame(b"nonsense", 0)
    assert master.stats().link.unexpected == 1
