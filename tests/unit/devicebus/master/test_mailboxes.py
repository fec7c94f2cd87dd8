"""Conversations with a simulated slave: fair, unmixed, under loss, and with hostile answers."""

from __future__ import annotations

import random

import pytest

from devicebus.errors import (
    BusError,
    MailboxProtocolError,
    MailboxRefusedError,
    MailboxSizeError,
    MailboxTimeoutError,
    WorkingCounterError,
)
from devicebus.mailbox import coe_client, foe_client
from devicebus.mailbox.conversation import MailboxRequest
from devicebus.master.mailboxes import RequestCounters, Unsolicited
from devicebus.sim.spec import EntrySpec, FileSpec, MailboxSpec, ObjectSpec
from eap.codec.coe import CoeService, encode_message
from eap.codec.mailbox import MailboxHeader, MailboxType
from eap.codec.mailbox import encode_message as encode_mailbox
from eap.od.abort import SdoAbortError
from tests.support.busline import MS, Bench, Line, open_mailbox, segment, slave

VENDOR = b"\x5a\x0e\0\0"
BIG = ObjectSpec(index=0x8001, name="big", type="BLOCK(2000)")
NUMBERS = ObjectSpec(
    index=0x8000,
    name="numbers",
    entries=tuple(EntrySpec(subindex=n, name=f"n{n}", type="UDINT", value=n) for n in range(1, 31)),
)


@pytest.fixture
def line():
    device = slave(
        "a", mailbox=MailboxSpec(foe=True), files=(FileSpec(name="f"),), objects=(BIG, NUMBERS)
    )
    return Line(Bench(), segment(device))


@pytest.fixture
def box(line):
    return open_mailbox(line)


@pytest.fixture
def slow(line):
    return open_mailbox(line, slow=True)


def server(line):
    return line.segment.slaves[0].device.mailbox


def start(line, box, conversation, **options):
    return box.converse(conversation, line.now_ns, **options)


def vendor():
    return coe_client.upload(0x1018, 1)


def number(n):
    return coe_client.upload(0x8000, n)


def test_mailbox_request_takes_two_frames(line, box):
    frames = line.frames
    assert line.wait(start(line, box, vendor())) == VENDOR
    assert line.frames - frames == 2
    stats = box.stats()
    assert (stats.sent, stats.received, stats.latency_ns) == (1, 1, 40_000)


def test_mailbox_error_reaches_the_requester(line, box):
    with pytest.raises(SdoAbortError, match="0x2000:00"):
        line.wait(start(line, box, coe_client.upload(0x2000, 0)))

    def soe():
        yield MailboxRequest(MailboxType.SOE, b"\1\x40\x20\0")

    with pytest.raises(MailboxRefusedError, match="slave 1001: mailbox error UNSUPPORTED_PROTOCOL"):
        line.wait(start(line, box, soe()))
    assert "UNSUPPORTED_PROTOCOL" in box.stats().last_error


def test_mailbox_too_long_message_is_refused_before_sending(line, box):
    frames = line.frames

    def large():
        yield MailboxRequest(MailboxType.COE, bytes(251))

    def grows():
        yield from vendor()
        yield from large()

    refused = start(line, box, large())
    with pytest.raises(MailboxSizeError, match=r"a request: .* 257 bytes, .* mailbox holds 256"):
        refused.result()
    assert line.frames == frames
    with pytest.raises(MailboxSizeError):
        line.wait(start(line, box, grows()))
    assert box.stats().sent == 1
    line.wait(start(line, box, vendor()))
    assert server(line).stats().gaps == 0


def test_mailbox_conversation_without_requests(line, box):
    def nothing():
        return 5
        yield

    def wrong():
        raise BusError("no")
        yield

    assert start(line, box, nothing()).result() == 5
    with pytest.raises(BusError, match="no"):
        start(line, box, wrong()).result()


def test_many_requesters_and_protocols_at_once_get_their_own_answers(line, box):
    content = bytes(range(256)) * 40
    got = bytearray()
    source = memoryview(content)
    at = 0

    def read(size):
        nonlocal at
        piece = bytes(source[at : at + size])
        at += len(piece)
        return piece

    written = start(line, box, foe_client.write("f", read, box.sizes), requester="file")
    sdos = [(n, start(line, box, number(n), requester=f"r{n % 3}")) for n in range(1, 31)]
    big = start(line, box, coe_client.upload(0x8001, 0), requester="big")
    for n, task in sdos:
        assert line.wait(task) == n.to_bytes(4, "little")
    assert not written.is_done
    assert len(line.wait(big)) == 2000
    line.wait(written)
    line.wait(start(line, box, foe_client.read("f", got.extend, box.sizes)))
    assert got == content


@pytest.mark.parametrize("seed", range(4))
def test_mailbox_with_lost_frames_executes_each_request_once(line, box, seed):
    dice = random.Random(seed)
    line.lose_out = lambda _: dice.random() < 0.1
    line.lose_back = lambda _: dice.random() < 0.1
    for n in range(1, 31):
        task = start(line, box, coe_client.download(0x8000, n, bytes((n, seed, 0, 0)), box.sizes))
        line.wait(task)
    tasks = [(n, start(line, box, number(n), requester=n)) for n in range(1, 31)]
    for n, task in tasks:
        assert line.wait(task) == bytes((n, seed, 0, 0))
    stats = box.stats()
    assert stats.timeouts == stats.errors == stats.late == stats.gaps == 0
    assert stats.repeats > 0


def test_mailbox_late_reply_after_a_time_out_is_dropped(line, slow):
    server(line).delay_ns = 2500 * MS
    begun = line.now_ns
    with pytest.raises(MailboxTimeoutError, match="slave 1001: no COE reply within 2000 ms"):
        line.wait(start(line, slow, number(1)))
    assert line.now_ns - begun < 2005 * MS
    server(line).delay_ns = 1000 * MS
    line.wait(start(line, slow, coe_client.download(0x8000, 1, b"\x99\0\0\0", slow.sizes)))
    assert line.wait(start(line, slow, number(1))) == b"\x99\0\0\0"
    assert (slow.stats().timeouts, slow.stats().late) == (1, 1)


@pytest.mark.parametrize("echoes", [True, False])
def test_mailbox_late_reply_does_not_answer_the_repeated_request(line, slow, echoes):
    server(line).echoes = echoes
    server(line).delay_ns = 2100 * MS
    with pytest.raises(MailboxTimeoutError):
        line.wait(start(line, slow, number(1)))
    server(line).delay_ns = 500 * MS
    line.wait(start(line, slow, vendor()))
    assert slow.stats().late == 1
    server(line).delay_ns = 2100 * MS
    with pytest.raises(MailboxTimeoutError):
        line.wait(start(line, slow, number(1)))
    line.segment.slaves[0].device.dictionary.entry(0x8000, 1).value = 77
    server(line).delay_ns = 300 * MS
    begun = line.now_ns
    assert line.wait(start(line, slow, number(1))) == b"\x4d\0\0\0"
    assert line.now_ns - begun >= 300 * MS
    assert slow.stats().late == 2


def test_mailbox_that_stays_full_has_its_own_error(line, box):
    line.segment.slaves[0].esc.channels[0].is_stuck = True
    with pytest.raises(MailboxTimeoutError, match="no COE reply"):
        line.wait(start(line, box, vendor()))
    with pytest.raises(MailboxTimeoutError, match="its mailbox is still full"):
        line.wait(start(line, box, vendor()))
    line.segment.slaves[0].esc.channels[0].is_stuck = False
    assert line.wait(start(line, box, vendor())) == VENDOR


def test_mailbox_lost_slave_fails_at_once(line, box):
    line.segment.switch(0, on=False)
    line.segment.switch(0, on=True)
    begun = line.now_ns
    with pytest.raises(WorkingCounterError, match="slave 1001"):
        line.wait(start(line, box, vendor()))
    assert line.now_ns - begun < MS


def test_cancelling_leaves_the_mailbox_usable(line, slow):
    server(line).delay_ns = 100 * MS
    first = start(line, slow, number(1))
    second = start(line, slow, number(2))
    line.elapse(10 * MS)
    first.cancel()
    second.cancel()
    assert line.wait(start(line, slow, number(3))) == b"\3\0\0\0"
    assert slow.stats().timeouts == 0


def test_mailbox_close_fails_all_conversations(line, slow):
    server(line).delay_ns = 100 * MS
    tasks = [start(line, slow, number(n)) for n in (1, 2)]
    line.elapse(10 * MS)
    slow.close()
    tasks.append(start(line, slow, number(3)))
    for task in tasks:
        with pytest.raises(BusError, match=r"slave 1001: a request: .* mailbox (was|is) closed"):
            task.result()
    slow.poll(line.now_ns)
    frames = line.frames
    line.elapse(10 * MS)
    assert line.frames == frames


class Talker:
    """A protocol server that says what it is told to."""

    def __init__(self):
        self.unasked = []

    def receive_message(self, data, now_ns):
        del now_ns
        return [data]

    def messages_to_send(self, now_ns):
        del now_ns
        unasked, self.unasked = self.unasked, []
        return unasked

    def reset(self):
        pass


EMERGENCY = encode_message(CoeService.EMERGENCY, bytes(range(8)))


def test_mailbox_unsolicited_message_is_reported_beside_a_request(line, box):
    protocols = server(line).protocols
    protocols[MailboxType.VOE] = talker = Talker()
    talker.unasked = [b"news"]
    line.elapse(2 * MS)
    box.poll(line.now_ns)
    line.elapse(2 * MS)
    assert line.unsolicited == [Unsolicited(1001, MailboxType.VOE, b"news")]
    talker.unasked = [b"more"] * 3
    line.elapse(2 * MS)
    assert line.wait(start(line, box, vendor())) == VENDOR
    box.poll(line.now_ns)
    line.elapse(2 * MS)
    assert len(line.unsolicited) == 4
    assert box.stats().unsolicited == 4


def test_mailbox_request_during_a_poll_is_served(line, box):
    box.poll(line.now_ns)
    assert line.wait(start(line, box, vendor())) == VENDOR


def echo(data=b"abc", **options):
    def talk():
        reply = yield MailboxRequest(MailboxType.VOE, data, **options)
        return reply.data

    return talk()


def test_mailbox_conversation_delays_sends_and_listens(line, box):
    server(line).protocols[MailboxType.VOE] = Talker()

    def talk():
        sent = yield MailboxRequest(MailboxType.VOE, b"one", expects_reply=False)
        first = yield MailboxRequest(MailboxType.VOE, b"one", listen=True)
        late = yield MailboxRequest(MailboxType.VOE, b"two", delay_ns=50 * MS)
        return sent.data, first.data, late.data

    begun = line.now_ns
    waiting = start(line, box, talk())
    line.elapse(2 * MS)
    assert line.wait(start(line, box, vendor())) == VENDOR
    assert line.now_ns - begun < 10 * MS
    assert line.wait(waiting) == (b"", b"one", b"two")
    assert line.now_ns - begun >= 50 * MS


def test_mailbox_fragments_are_stored_for_the_listener(line, box):
    """A client in another process still listens after the slave has sent the rest."""

    def ask(request, **options):
        return (yield MailboxRequest(MailboxType.COE, request, **options)).data

    request = encode_message(CoeService.SDO_INFORMATION, bytes.fromhex("01 00 0000 0100"))
    server(line).sizes.set(128, 16)
    parts = [line.wait(start(line, box, ask(request)))]
    while left := int.from_bytes(parts[-1][4:6], "little"):
        line.elapse(20 * MS)
        box.poll(line.now_ns)
        line.elapse(20 * MS)
        parts.append(line.wait(start(line, box, ask(request[:6], listen=True))))
        assert int.from_bytes(parts[-1][4:6], "little") == left - 1
    assert len(parts) > 3
    assert box.stats().late == 0


def test_errors_of_files_end_the_conversation_only(line, box):
    server(line).protocols[MailboxType.VOE] = Talker()

    def broken():
        yield MailboxRequest(MailboxType.VOE, b"x")
        raise OSError("no space left")

    with pytest.raises(BusError, match="slave 1001: saving: no space left"):
        line.wait(start(line, box, broken(), name="saving"))
    assert line.wait(start(line, box, echo())) == b"abc"


def test_mailbox_reply_during_a_repeated_write_is_accepted(line, box):
    device = line.segment.slaves[0]
    device.esc.channels[0].is_stuck = True
    first = line.frames

    def unstick(number):
        if number == first + 2:
            device.esc.channels[0].is_stuck = False
            device.handle_timeout(line.now_ns)
        return False

    line.lose_back = lambda number: number == first
    line.lose_out = unstick
    assert line.wait(start(line, box, vendor())) == VENDOR
    assert server(line).stats().received == 1
    assert line.wait(start(line, box, number(2))) == b"\2\0\0\0"


def test_mailbox_endless_unsolicited_messages_are_read_in_portions(line, box):
    talker = server(line).protocols[MailboxType.VOE] = Talker()
    talker.messages_to_send = lambda now: [b"again"]
    line.elapse(2 * MS)
    box.poll(line.now_ns)
    line.elapse(5 * MS)
    assert len(line.unsolicited) <= 16
    assert line.wait(start(line, box, vendor())) == VENDOR


def raw(line, octets):
    """Let the slave answer the next request with these bytes."""
    mailbox = server(line)
    mailbox.receive_message = lambda message, now: mailbox._queue.append(octets)


@pytest.mark.parametrize(
    ("octets", "error", "text"),
    [
        (b"\xff\xff\0\0\0\x13", MailboxTimeoutError, "no COE reply"),
        (b"\x0a\0\0\0\0\x19" + bytes(10), MailboxTimeoutError, "no COE reply"),
        (b"", MailboxProtocolError, "a mailbox error of 0 bytes"),
        (encode_mailbox(MailboxHeader(0, type=MailboxType.FOE), bytes(6)), MailboxTimeoutError,
         "no COE reply"),
        (encode_mailbox(MailboxHeader(0, type=MailboxType.ERR), b"\1"), MailboxProtocolError,
         "a mailbox error of 1 bytes"),
        (encode_mailbox(MailboxHeader(0, type=MailboxType.ERR), b"\1\0\x99\0"),
         MailboxRefusedError, "mailbox error 0x0099"),
    ],
)  # fmt: skip
def test_hostile_answers_end_in_named_errors(line, box, octets, error, text):
    raw(line, octets)
    with pytest.raises(error, match=text):
        line.wait(start(line, box, vendor()))
    del server(line).receive_message
    assert line.wait(start(line, box, vendor())) == VENDOR


def test_mailbox_counters_have_latencies_and_errors():
    counters = RequestCounters()
    nothing = counters.stats(repeats=0, duplicates=0, gaps=0)
    assert (nothing.mean_latency_ns, nothing.last_error) == (0, "")
    for latency in (30, 10, 20):
        counters.answer(latency)
    counters.fail(MailboxTimeoutError("slow"))
    counters.fail(BusError("odd"))
    stats = counters.stats(repeats=1, duplicates=2, gaps=3)
    assert (stats.latency_ns, stats.mean_latency_ns, stats.max_latency_ns) == (20, 20, 30)
    assert (stats.timeouts, stats.errors, stats.last_error) == (1, 1, "odd")
    assert (stats.repeats, stats.duplicates, stats.gaps) == (1, 2, 3)
    assert (stats.unanswered, stats.unanswered_ns) == (0, None)  # of what it listened for
    counters.miss(50)
    counters.miss(70)
    counters.late = 1
    stats = counters.stats(repeats=0, duplicates=0, gaps=0)
    assert (stats.unanswered, stats.unanswered_ns, stats.late) == (2, 70, 1)
    counters.forget_unanswered()
    stats = counters.stats(repeats=0, duplicates=0, gaps=0)
    assert (stats.unanswered, stats.unanswered_ns, stats.late, stats.timeouts) == (0, None, 0, 1)
