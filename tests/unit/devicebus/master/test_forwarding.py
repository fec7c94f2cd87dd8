"""Mailbox messages between slaves, which the master forwards."""

from __future__ import annotations

import pytest

from devicebus.mailbox import coe_client
from devicebus.master.master import Master
from devicebus.master.queues import MAX_WAITING
from devicebus.wire.alstatus import AlState
from eap.codec.coe import CoeService, SdoRequest, encode_message, encode_plain
from eap.codec.mailbox import MailboxType, decode_message
from tests.support.busline import MS, Paced, SlowServer, segment, slave

FIRST, SECOND = 1001, 1002
ASK = encode_message(CoeService.SDO_REQUEST, encode_plain(SdoRequest.UPLOAD, 0x1018, 1))
VENDOR = slave("x").vendor.to_bytes(4, "little")


class Rig:
    """A master with three slaves in OP; what comes to the first by mailbox is kept."""

    def __init__(self):
        self.line = Paced(Master(), segment(slave("a"), slave("b"), slave("c", mailbox=None)))
        self.line.wait(self.line.core.bring_up(self.line.now_ns))
        self.server = self.line.segment.slaves[0].device.mailbox
        self.came = []
        original = self.server.receive_message

        def receive(message, now_ns):
            header, data = decode_message(message)
            if header.address != SECOND:
                original(message, now_ns)
                return
            # Taken by the client in the slave: its server would refuse a reply, and be refused.
            self.came.append((header.address, header.type, bytes(data)))

        self.server.receive_message = receive

    def send(self, data=ASK, address=SECOND, kind=MailboxType.COE):
        self.server._enqueue(kind, data, address)

    def elapse(self, duration_ns=50 * MS):
        self.line.elapse(duration_ns)

    def stats(self, station=FIRST):
        return self.line.core.stats().mailboxes[station]


def test_request_of_a_slave_is_forwarded_and_its_reply_returned_with_the_address_swapped():
    rig = Rig()
    rig.send()
    rig.elapse()
    ((address, kind, data),) = rig.came
    assert (address, kind) == (SECOND, MailboxType.COE)
    assert data[:3] == b"\0\x30\x43"
    assert data[-4:] == VENDOR
    assert (rig.stats().forwarded, rig.stats(SECOND).forwarded) == (1, 1)
    assert (rig.stats().forward_dropped, rig.stats().late, rig.stats(SECOND).late) == (0, 0, 0)


def test_reply_of_a_slave_that_does_not_echo_addresses_goes_back_too():
    rig = Rig()
    device = rig.line.segment.slaves[1].device
    device.mailbox = SlowServer(device.mailbox)
    device.mailbox.echoes = False
    rig.send()
    rig.elapse()
    ((address, _, data),) = rig.came
    assert address == SECOND
    assert data[-4:] == VENDOR
    assert rig.stats(SECOND).late == 0


def test_forwarded_messages_go_on_beside_conversations_of_the_master():
    rig = Rig()
    master, line = rig.line.core, rig.line
    tasks = [
        master.converse(station, coe_client.upload(0x1018, 1), line.now_ns)
        for station in (FIRST, SECOND) * 10
    ]
    for _ in range(5):
        rig.send()
        rig.elapse(5 * MS)
    rig.elapse()
    assert {task.result() for task in tasks} == {VENDOR}
    replies = [data for address, _, data in rig.came if address == SECOND]
    assert [data[-4:] for data in replies] == [VENDOR] * 5
    assert line.events() == []


@pytest.mark.parametrize("address", [1003, SECOND])
def test_message_to_a_slave_without_open_mailbox_is_dropped_and_counted(address):
    rig = Rig()
    rig.line.wait(rig.line.core.request_state(SECOND, AlState.INIT, rig.line.now_ns))
    rig.send(address=address)
    rig.elapse()
    assert rig.came == []
    assert (rig.stats().forwarded, rig.stats().forward_dropped) == (0, 1)


@pytest.mark.parametrize("address", [0, FIRST, 1009, 0x8001])
def test_message_to_no_other_slave_is_not_forwarded(address):
    rig = Rig()
    rig.send(address=address)
    rig.elapse()
    assert (rig.stats().forwarded, rig.stats().forward_dropped) == (0, 0)
    assert rig.came == []


def test_messages_that_do_not_fit_or_are_too_many_are_dropped():
    rig = Rig()
    second = rig.line.core.slaves[SECOND].mailbox
    assert not second.post(FIRST, MailboxType.COE, bytes(300), rig.line.now_ns)
    rig.line.segment.slaves[1].esc.channels[0].is_stuck = True
    taken = [second.post(FIRST, MailboxType.VOE, bytes(10), rig.line.now_ns) for _ in range(40)]
    assert taken.count(True) == MAX_WAITING
    rig.elapse(3000 * MS)
    # The first is in the mailbox that the slave does not read; the others have waited too long.
    assert rig.stats(SECOND).forward_dropped == MAX_WAITING - 1
    rig.line.segment.slaves[1].esc.channels[0].is_stuck = False
    rig.elapse(100 * MS)
    task = rig.line.core.converse(SECOND, coe_client.upload(0x1018, 1), rig.line.now_ns)
    assert rig.line.wait(task) == VENDOR
