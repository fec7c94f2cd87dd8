"""Order of the conversations with a slave, and replies that are matched to their requests."""

from __future__ import annotations

import pytest

from devicebus.errors import BusError
from devicebus.mailbox.conversation import MailboxRequest, is_unsolicited
from devicebus.master.queues import (
    ConversationQueue,
    QueuedConversation,
    ReplyMatcher,
)
from eap.codec.coe import CoeService, encode_message
from eap.codec.mailbox import MailboxHeader, MailboxType

COE, FOE, ERR = MailboxType.COE, MailboxType.FOE, MailboxType.ERR
YES, NO = (bytes.fromhex(f"0030 43 1810 0{n} 00000000") for n in (1, 2))
ASK, ASK_OTHER = (MailboxRequest(COE, bytes.fromhex(f"0020 40 1810 0{n} 00000000")) for n in (1, 3))


@pytest.fixture
def matcher():
    return ReplyMatcher(COE)


def give(matcher, data=YES, *, address=0, kind=COE, ask=ASK):
    return matcher.answers(MailboxHeader(0, address, type=kind), data, ask)


def test_reply_matcher_uses_protocol_and_content(matcher):
    assert matcher.next_address() == 0
    assert give(matcher)
    assert give(matcher, address=1001)
    assert not give(matcher, NO)
    assert not give(matcher, kind=FOE)
    assert give(matcher, kind=ERR)


def test_reply_matcher_tags_requests_after_a_time_out(matcher):
    matcher.next_address()
    matcher.expire(ASK)
    tag = matcher.next_address()
    assert tag & 0x8000
    assert give(matcher, address=tag)
    assert not give(matcher, address=0)
    again = matcher.next_address()
    assert again != tag
    assert not give(matcher, address=tag)
    assert not give(matcher, kind=ERR, address=tag)
    assert give(matcher, kind=ERR, address=again)


def test_tags_go_round_and_are_never_0(matcher):
    matcher.expire(ASK)
    tags = {matcher.next_address() for _ in range(0x5000)}
    assert min(tags) >= 0x8000
    assert max(tags) <= 0xFFFF


def test_without_echo_the_first_fitting_reply_is_the_late_one(matcher):
    matcher.expire(ASK)
    matcher.next_address()
    assert not give(matcher, NO)
    assert not give(matcher)
    assert give(matcher)


def test_reply_matcher_without_echo_loses_one_more_reply_at_most(matcher):
    matcher.expire(ASK)
    matcher.next_address()
    assert not give(matcher)
    matcher.expire(ASK)
    matcher.next_address()
    assert give(matcher)


def test_reply_matcher_removes_the_expired_request_of_a_late_reply(matcher):
    matcher.expire(ASK)
    matcher.next_address()
    assert not give(matcher, ask=ASK_OTHER)
    assert give(matcher)


def test_reply_matcher_without_echo_drops_a_late_mailbox_error(matcher):
    matcher.expire(ASK)
    matcher.next_address()
    assert not give(matcher, kind=ERR)
    assert give(matcher, kind=ERR)


@pytest.mark.parametrize(
    ("kind", "data", "expected"),
    [
        (COE, encode_message(CoeService.EMERGENCY, bytes(8)), True),
        (COE, encode_message(CoeService.TX_PDO, bytes(8)), True),
        (COE, encode_message(CoeService.TX_PDO_REMOTE_REQUEST, b""), True),
        (COE, encode_message(CoeService.RX_PDO_REMOTE_REQUEST, b""), True),
        (COE, encode_message(CoeService.RX_PDO, bytes(8)), False),
        (COE, encode_message(CoeService.SDO_RESPONSE, bytes(8)), False),
        (COE, b"\0\xf0", False),
        (COE, b"", False),
        (MailboxType.SOE, b"\x05\x40\x20\0", True),
        (MailboxType.SOE, b"\x06\x40\x20\0", True),
        (MailboxType.SOE, b"\x02\x40\x20\0", False),
        (MailboxType.EOE, b"\0\0\0\0", True),
        (MailboxType.EOE, b"\x03\0\0\0", False),
        (FOE, bytes(6), False),
        (MailboxType.VOE, bytes(6), True),
        (MailboxType.AOE, bytes(32), True),
        (MailboxType.AOE, bytes(18) + b"\5\0" + bytes(12), False),
        (MailboxType.AOE, bytes(16) + b"\2\x09\6\0" + bytes(12), False),
        (MailboxType.AOE, b"news", False),
        (ERR, b"\1\0\2\0", False),
    ],
)
def test_is_unsolicited_by_protocol_and_service(kind, data, expected):
    assert is_unsolicited(kind, data) is expected


LISTED = MailboxRequest(COE, bytes.fromhex("0080 01 00 0000 0100"))
PARTS = [bytes.fromhex(f"0080 {head} 00{n:02x}10") for n, head in
         enumerate(("82 00 0200 0100", "82 00 0100", "02 00 0000"))]  # fmt: skip
EMERGENCY = encode_message(CoeService.EMERGENCY, bytes(8))
REST = MailboxRequest(COE, LISTED.request[:6], listen=True)


def test_reply_matcher_stores_fragments_before_the_listener(matcher):
    matcher.next_address()
    assert not matcher.store(PARTS[1])
    assert give(matcher, PARTS[0], ask=LISTED)
    matcher.note_part(PARTS[0])
    assert not matcher.store(EMERGENCY)
    assert matcher.store(PARTS[1])
    assert matcher.store(PARTS[2])
    assert not matcher.store(PARTS[2])
    assert [matcher.take_stored(REST) for _ in range(3)] == [*PARTS[1:], None]


def test_reply_matcher_drops_stored_fragments_with_the_next_request(matcher):
    matcher.note_part(PARTS[0])
    assert matcher.store(PARTS[1])
    matcher.next_address()
    assert matcher.take_stored(REST) is None
    assert not matcher.store(PARTS[1])


def test_not_all_is_kept(matcher):
    matcher.note_part(PARTS[0])
    assert sum(matcher.store(PARTS[1]) for _ in range(100)) == 64


def test_kept_messages_that_answer_something_else_are_dropped(matcher):
    matcher.note_part(PARTS[0])
    matcher.store(YES)
    assert matcher.take_stored(REST) is None


def talk(kind, *, listen):
    yield MailboxRequest(kind, b"", listen=listen)


def job(name, requester="r", kind=COE, listen=False, ready_ns=0):
    conversation = talk(kind, listen=listen)
    made = QueuedConversation(conversation, next(conversation), name, requester)
    made.ready_ns = ready_ns
    return made


def order(queue, *, count):
    names = []
    for _ in range(count):
        taken = queue.next_job(0)
        names.append(taken.task.name)
        taken.task.finish(None)
    return names


def test_conversation_queue_alternates_requesters():
    queue = ConversationQueue()
    for number in range(3):
        queue.add(job(f"greedy{number}", "g"))
    queue.add(job("a", "a"))
    queue.add(job("b", "b"))
    assert order(queue, count=5) == ["greedy0", "greedy1", "a", "b", "greedy2"]
    assert queue.next_job(0) is None


def test_conversation_queue_runs_one_conversation_of_a_protocol():
    queue = ConversationQueue()
    queue.add(job("first"))
    queue.add(job("second", "s"))
    assert [queue.next_job(0).task.name for _ in range(3)] == ["first"] * 3


def test_conversation_queue_alternates_protocols_by_message():
    queue = ConversationQueue()
    queue.add(job("file", kind=FOE))
    queue.add(job("sdo"))
    assert [queue.next_job(0).task.name for _ in range(4)] == ["file", "sdo", "file", "sdo"]


def test_conversation_queue_prefers_listeners():
    queue = ConversationQueue()
    queue.add(job("file", kind=FOE))
    queue.add(job("fragments", listen=True))
    assert [queue.next_job(0).task.name for _ in range(3)] == ["fragments"] * 3


def test_conversation_queue_pause_of_one_does_not_delay_others():
    queue = ConversationQueue()
    queue.add(job("busy", kind=FOE, ready_ns=50))
    assert (queue.next_job(49), queue.next_ready()) == (None, 50)
    queue.add(job("sdo"))
    assert queue.next_job(49).task.name == "sdo"
    assert queue.next_ready() == 0
    assert queue.next_job(50).task.name == "busy"


def test_cancelled_conversations_are_passed_by():
    queue = ConversationQueue()
    jobs = [job(str(number)) for number in range(3)]
    for each in jobs:
        queue.add(each)
    jobs[0].task.cancel()
    jobs[1].task.cancel()
    assert queue.next_job(0) is jobs[2]
    jobs[2].task.cancel()
    assert (queue.next_job(0), queue.next_ready()) == (None, None)


def test_conversation_queue_fails_all_conversations():
    queue = ConversationQueue()
    jobs = [job("a"), job("b"), job("c", kind=FOE)]
    for each in jobs:
        queue.add(each)
    jobs[0].task.finish(1)
    queue.fail_all("it is gone")
    assert jobs[0].task.result() == 1
    for each in jobs[1:]:
        with pytest.raises(BusError, match=f"{each.task.name}: it is gone"):
            each.task.result()
    assert queue.next_job(0) is None


def test_conversation_queue_has_a_matcher_for_each_protocol():
    queue = ConversationQueue()
    assert queue.matcher(COE) is queue.matcher(COE)
    assert queue.matcher(COE) is not queue.matcher(FOE)
