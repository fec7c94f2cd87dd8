from __future__ import annotations

from typing import get_args

import pytest

from devicebus.mailbox.conversation import MailboxRequest
from devicebus.master import bus
from devicebus.master.bus import MAX_EVENTS, BusLost, BusSlave, BusState, MasterSettings
from devicebus.master.cycle import Participation
from devicebus.master.mailboxes import MailboxArea
from devicebus.master.scan import scan
from devicebus.master.startup import set_up_cycle
from devicebus.wire.datagram import frmw
from eap.codec.mailbox import MailboxType
from tests.support.busline import Bench, Line, run, segment, slave

KINDS = [each for each in get_args(bus.Event) if each.__module__ == bus.__name__]


@pytest.mark.parametrize("kind", KINDS)
def test_every_event_tells_when_and_cannot_be_changed(kind):
    made = kind(*range(len(kind.__struct_fields__)))
    assert kind.__struct_fields__[-1] == "at_ns"
    with pytest.raises(AttributeError):
        made.at_ns = 5


AREA = MailboxArea(0x1000, 128, 0x1080, 128)


def made():
    (found,) = run(Line(Bench(), segment(slave("a"))), scan())
    bus = BusState(MasterSettings(acyclic_octets=100))
    unit = bus.slaves[1001] = BusSlave(found, "first")
    return bus, unit


def test_events_come_in_their_order_and_the_oldest_are_dropped():
    bus, _ = made()
    for at in range(MAX_EVENTS + 2):
        bus.emit(BusLost(at))
    assert bus.next_event() == BusLost(2)
    assert len(list(iter(bus.next_event, None))) == MAX_EVENTS - 1


def test_bus_closed_mailbox_fails_pending_requests():
    bus, unit = made()
    bus.open_mailbox(unit, AREA)
    first = unit.mailbox

    closed = first.converse(talk(), 0)
    bus.open_mailbox(unit, AREA)
    assert closed.is_done
    assert unit.mailbox is not first
    bus.close_mailbox(unit)
    bus.close_mailbox(unit)
    assert unit.mailbox is None


def talk():
    yield MailboxRequest(MailboxType.COE, b"")


def test_bus_reset_ends_running_tasks():
    bus, unit = made()
    bus.set_participation(unit, Participation.ACTIVE)
    set_up_cycle(bus)
    bus.open_mailbox(unit, AREA)
    unit.work = bus.runner.start(scan(), 0)
    assert unit.is_busy
    bus.is_lost = bus.needs_check = True
    bus.reset()
    assert not unit.is_busy
    assert (bus.slaves, bus.image, bus.cycle, unit.mailbox) == ({}, None, None, None)
    assert not bus.is_lost
    assert not bus.needs_check


def test_bus_distributes_the_reference_time_in_every_cycle():
    bus, _ = made()
    bus.distribute_time(1001)
    assert bus.reference == 1001
    set_up_cycle(bus)
    assert bus.cycle.extra == [frmw(1001, 0x0910, 8)]
    bus.distribute_time(None)
    assert (bus.reference, bus.cycle.extra) == (None, [])
