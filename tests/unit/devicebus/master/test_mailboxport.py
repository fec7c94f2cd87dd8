from __future__ import annotations

import pytest

from devicebus.errors import BusError, FrameLostError, WorkingCounterError
from devicebus.master.mailboxes import MailboxArea, MailboxPort, WriteResult, configure
from devicebus.master.scan import assign_stations
from devicebus.wire.datagram import Command, DatagramReply, DatagramRequest
from devicebus.wire.register import Register, SyncManager
from tests.support.busline import Bench, Line, drive, run, segment, slave

AREA = MailboxArea(0x1000, 32, 0x1080, 48)


def test_sync_managers_of_a_mailbox():
    written, fetched = AREA.sync_managers()
    assert written.encode().hex() == "0010200026000100"
    assert fetched.encode().hex() == "8010300022000100"


def test_configuring_writes_both():
    line = Line(Bench(), segment(slave("a")))
    run(line, assign_stations([(0, 1001)]))
    run(line, configure(1001, AREA))
    memory = line.segment.slaves[0].esc.memory
    there = [SyncManager.decode(memory, Register.SYNC_MANAGER + at) for at in (0, 8)]
    assert tuple(there) == AREA.sync_managers()
    with pytest.raises(WorkingCounterError, match="slave 1009: writing sync managers"):
        run(line, configure(1009, AREA))


@pytest.mark.parametrize(
    ("area", "reason"),
    [
        ((0x1000, 1487, 0x1800, 32), "its mailbox of 1487 bytes at 0x1000 cannot be"),
        ((0x1000, 32, 0x0800, 32), "32 bytes at 0x0800 cannot be, .* from 0x1000 on"),
        ((0x1000, 32, 0xFFF0, 32), "32 bytes at 0xFFF0 cannot be"),
    ],
)
def test_mailboxes_that_cannot_be(area, reason):
    with pytest.raises(BusError, match=f"slave 7: .*{reason}"):
        MailboxArea(*area).check(7)
    MailboxArea(0x1000, 1486, 0xFFE0, 32).check(7)


class Wire:
    """One slave that has *status* and *reply*; *loses* the next so many mailbox reads."""

    def __init__(self, *, reply=b"", wkc=1, tries=1, acknowledges=True):
        self.reply = reply
        self.wkc = wkc
        self.tries = tries
        self.acknowledges = acknowledges
        self.accesses = []
        self.repeat = 0

    def __call__(self, access):
        self.accesses.append(access)
        if access.ado == 0x080E:
            self.repeat = access.data[0] & 2
        if access.ado == 0x080F:
            return DatagramReply(bytes((self.repeat * self.acknowledges,)), 1)
        if access.ado == 0x080D:
            return DatagramReply(b"\x08" if self.reply else b"\0", 1)
        return DatagramReply(self.reply, self.wkc, self.tries)


def test_mailbox_port_writes_the_whole_mailbox():
    wire = Wire()
    assert drive(MailboxPort(7, AREA).write_message(b"abc"), wire) == WriteResult(True, False)
    assert wire.accesses == [DatagramRequest(Command.FPWR, 7, 0x1000, b"abc".ljust(32, b"\0"), 0)]


def test_mailbox_port_full_mailbox_refuses_a_message():
    assert drive(MailboxPort(7, AREA).write_message(b"abc"), Wire(wkc=0)) == WriteResult(
        False, False
    )
    assert drive(MailboxPort(7, AREA).write_message(b"abc"), Wire(wkc=0, tries=2)) == WriteResult(
        False, True
    )


def test_mailbox_port_reads_each_message_once():
    wire = Wire(reply=b"x" * 48)
    port = MailboxPort(7, AREA)
    assert drive(port.is_full(), wire)
    assert drive(port.read_message(), wire) == b"x" * 48
    assert wire.accesses[-1] == DatagramRequest(Command.FPRD, 7, 0x1080, bytes(48), 1)
    assert drive(port.read_message(), Wire(wkc=0)) is None
    assert not drive(port.is_full(), Wire())


def lose_read(port):
    fetching = port.read_message()
    next(fetching)
    with pytest.raises(StopIteration) as end:
        fetching.throw(FrameLostError("gone"))
    assert end.value.value is None


def test_mailbox_port_requests_a_lost_reply_again():
    port, wire = MailboxPort(7, AREA), Wire(reply=b"x")
    lose_read(port)
    assert drive(port.is_full(), wire)
    assert wire.accesses[0] == DatagramRequest(Command.FPWR, 7, 0x080E, b"\x03", 0)
    assert drive(port.read_message(), wire) == b"x"
    assert len(wire.accesses) == 4
    lose_read(port)
    assert drive(port.is_full(), wire)
    assert wire.accesses[4].data == b"\x01"
    assert port.repeats == 2


def test_mailbox_port_without_any_frame_back_asks_again_with_the_same_bit():
    port, wire = MailboxPort(7, AREA), Wire(reply=b"x")
    lose_read(port)
    asking = port.is_full()
    next(asking)
    with pytest.raises(FrameLostError):
        asking.throw(FrameLostError("gone"))
    assert drive(port.is_full(), wire)
    assert wire.accesses[0].data == b"\x03"
    assert port.repeats == 1


def test_mailbox_port_repeat_without_acknowledge_times_out():
    wire = Wire(acknowledges=False)
    port = MailboxPort(7, AREA)
    lose_read(port)
    assert not drive(port.is_full(), wire)
    assert 100 < len(wire.accesses) < 500 + 3
