from __future__ import annotations

import pytest
from msgspec.structs import replace

from devicebus.master.cycle import MAX_UNDER_WAY, Cycle, Participation
from devicebus.master.cyclicframe import MAX_DATAGRAMS
from devicebus.master.image import BASE, BusImage, plan_image
from devicebus.master.link import BACKOFF_LIMIT_NS, LINGER_NS, Link
from devicebus.wire.datagram import Command, DatagramRequest, fprd, frmw
from tests.support.busline import MS, accesses_of, answer
from tests.unit.devicebus.master.test_image import shape

SHAPES = (shape(1, (8, 8), (16,)), shape(2, (8,), (8,)), shape(3, (), (8,)))


class Fixture:
    def __init__(self, *, knows_lrw=True, present=(1, 2, 3)):
        self.link = Link()
        self.image = BusImage(plan_image(SHAPES))
        self.troubles = []
        self.cycle = Cycle(self.link, self.image, self.troubles.append, knows_lrw=knows_lrw)
        for station in present:
            self.cycle.set_participation(station, Participation.ACTIVE)

    def round(self, wkc, data=b"", now_ns=0):
        self.cycle.start(now_ns)
        frames = self.link.frames_to_send(now_ns)
        for frame in frames:
            self.link.receive_frame(answer(frame, wkc=wkc, data=data), now_ns + 50)
        return [access for frame in frames for access in accesses_of(frame)]


def test_cycle_exchanges_outputs_and_inputs_by_one_datagram():
    f = Fixture()
    f.image.outputs[:] = b"abc"
    (access,) = f.round(7, b"...WXYZ")
    assert access == DatagramRequest(Command.LRW, BASE & 0xFFFF, BASE >> 16, b"abc\0\0\0\0", 0)
    assert f.image.inputs == b"WXYZ"
    stats = f.cycle.stats()
    assert (stats.cycles, stats.good, stats.expected_wkc, stats.received_wkc) == (1, 1, 7, 7)
    assert (stats.trip_ns, stats.max_trip_ns, f.troubles) == (50, 50, [])


def test_slaves_that_do_not_know_lrw_are_written_and_read():
    f = Fixture(knows_lrw=False)
    f.image.outputs[:] = b"abc"
    write, read = f.round(3, b"WXYZ")
    assert (write.command, write.adp, write.data) == (Command.LWR, 0, b"abc")
    assert (read.command, read.adp, read.data) == (Command.LRD, 3, bytes(4))
    assert f.cycle.stats().expected_wkc == 2 + 3
    assert f.cycle.stats().wkc_errors == 1
    assert f.image.inputs == b"WXYZ"


def test_cycle_wrong_working_counter_keeps_the_inputs():
    f = Fixture()
    f.round(7, b"...WXYZ")
    f.round(4, b"...abcd", now_ns=MS)
    assert f.image.inputs == b"WXYZ"
    assert f.cycle.stats().wkc_errors == 1
    assert f.troubles == [MS + 50]


def test_cycle_updates_inputs_of_the_others_while_one_is_absent():
    f = Fixture()
    f.round(7, b"...WXYZ")
    f.cycle.set_participation(1, Participation.ABSENT)
    f.round(4, b"...\0\0yz")
    assert f.image.inputs == b"WXyz"
    assert f.cycle.stats().wkc_errors == 0
    assert f.cycle.participation(1) is Participation.ABSENT
    assert f.cycle.participation(99) is Participation.ABSENT


@pytest.mark.parametrize(("wkc", "errors"), [(4, 0), (6, 1), (7, 0), (3, 1), (8, 1)])
def test_cycle_uncertain_slave_counts_fully_or_not_at_all(wkc, errors):
    f = Fixture()
    f.cycle.set_participation(1, Participation.UNCERTAIN)
    f.round(wkc, b"...WXYZ")
    assert f.cycle.stats().wkc_errors == errors
    assert f.image.inputs == (b"\0\0\0\0" if errors else b"\0\0YZ")


def test_cycle_changed_participation_applies_from_the_next_cycle():
    f = Fixture()
    f.cycle.start(0)
    (frame,) = f.link.frames_to_send(0)
    f.cycle.set_participation(1, Participation.ABSENT)
    f.link.receive_frame(answer(frame, wkc=7), 1)
    assert f.cycle.stats().good == 1


def counts(f):
    stats = f.cycle.stats()
    return stats.good, stats.late, stats.lost, stats.skipped


def test_cycle_lost_is_counted_and_neither_sent_again_nor_held_against_slaves():
    f = Fixture()
    f.cycle.start(0)
    f.link.frames_to_send(0)
    f.link.handle_timeout(BACKOFF_LIMIT_NS)
    assert f.link.frames_to_send(BACKOFF_LIMIT_NS) == []
    assert counts(f) == (0, 0, 0, 0)
    f.link.handle_timeout(BACKOFF_LIMIT_NS + LINGER_NS)
    assert counts(f) == (0, 0, 1, 0)
    assert f.troubles == []


def test_cycle_late_is_counted_and_its_inputs_are_taken():
    f = Fixture()
    f.cycle.start(0)
    (frame,) = f.link.frames_to_send(0)
    f.link.handle_timeout(BACKOFF_LIMIT_NS)
    f.link.receive_frame(answer(frame, wkc=7, data=b"...WXYZ"), BACKOFF_LIMIT_NS + 1)
    assert f.image.inputs == b"WXYZ"
    assert counts(f) == (1, 1, 0, 0)


def test_cycle_overtaken_by_a_newer_one_is_ignored():
    f = Fixture()
    f.cycle.start(0)
    (older,) = f.link.frames_to_send(0)
    f.round(7, b"...new!", now_ns=MS)
    f.link.receive_frame(answer(older, wkc=7, data=b"...old!"), 2 * MS)
    assert f.image.inputs == b"new!"


def test_cycle_with_too_many_under_way_is_skipped():
    f = Fixture()
    frames = []
    for number in range(MAX_UNDER_WAY + 3):
        f.cycle.start(number)
        frames += f.link.frames_to_send(number)
    assert (len(frames), counts(f)) == (MAX_UNDER_WAY, (0, 0, 0, 3))
    f.link.receive_frame(answer(frames[0], wkc=7, data=b"...WXYZ"), MS)
    f.cycle.start(2 * MS)
    assert len(f.link.frames_to_send(2 * MS)) == 1
    f.link.handle_timeout(BACKOFF_LIMIT_NS + 2 * MS)
    f.cycle.start(BACKOFF_LIMIT_NS + 2 * MS)
    assert len(f.link.frames_to_send(BACKOFF_LIMIT_NS + 2 * MS)) == 1


def test_more_datagrams_go_with_a_cycle():
    f = Fixture()
    taken = []
    f.cycle.extra = [frmw(1, 0x910, 8)]
    f.cycle.note_time = lambda time_ns, now_ns: taken.append((time_ns, now_ns))
    accesses = f.round(7, b"\1\2\0\0\0\0\0")
    assert [each.command for each in accesses] == [Command.LRW, Command.FRMW]
    assert taken == [(0x201, 50)]
    f.round(0)
    assert len(taken) == 1  # no clock has put its time there


def test_cycle_that_looks_reports_full_mailboxes():
    f = Fixture()
    full = []
    reads = [fprd(station, 0x80D, 1, tries=1) for station in (1, 2, 3)]
    assert f.cycle.set_looks(reads, lambda number, now_ns: full.append((number, now_ns))) == 3
    assert len(f.round(7)) == 1
    f.cycle.start(MS, looks=True)
    (frame,) = f.link.frames_to_send(MS)
    assert accesses_of(frame)[1:] == [replace(each, tries=0) for each in reads]
    back = bytearray(answer(frame, wkc=7))
    back[-16] = back[-3] = 0x08
    back[-28:-26] = b"\0\0"
    f.link.receive_frame(back, MS + 50)
    assert full == [(1, MS + 50), (2, MS + 50)]
    assert f.cycle.stats().good == 2


def test_cycle_takes_as_many_looks_along_as_fit():
    f = Fixture()
    reads = [fprd(station, 0x80D, 1, tries=1) for station in range(20)]
    assert f.cycle.set_looks(reads, lambda number, now_ns: None) == MAX_DATAGRAMS - 1
    f.cycle.extra = [frmw(1, 0x910, 8)]
    f.link._piggyback = 30
    assert f.cycle.set_looks(reads, lambda number, now_ns: None) == 2
    assert f.cycle.set_looks([], lambda number, now_ns: None) == 0


def test_cycle_without_process_data_sends_nothing():
    cycle = Cycle(link := Link(), BusImage(plan_image([])), lambda now: None, knows_lrw=True)
    cycle.start(0)
    assert (link.frames_to_send(0), cycle.stats().cycles) == ([], 0)


def test_cycle_is_good_follows_the_last_cycle():
    f = Fixture()
    f.round(7)
    assert f.cycle.is_good
    assert f.cycle.is_full
    f.cycle.start(MS)
    assert not f.cycle.is_good
    f.round(6, now_ns=2 * MS)
    assert not f.cycle.is_good


def test_cycle_without_an_uncertain_slave_is_good_but_not_full():
    f = Fixture()
    f.cycle.set_participation(3, Participation.UNCERTAIN)
    f.round(6)
    assert f.cycle.is_good
    assert not f.cycle.is_full
    f.round(7)
    assert f.cycle.is_full
