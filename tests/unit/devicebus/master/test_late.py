from __future__ import annotations

import pytest

from devicebus.mailbox.conversation import MailboxRequest
from devicebus.master.late import ReplyJudge, is_unsolicited
from eap.codec.coe import CoeService, encode_message
from eap.codec.mailbox import MailboxHeader, MailboxType

COE, FOE, ERR = MailboxType.COE, MailboxType.FOE, MailboxType.ERR
YES, NO = (bytes.fromhex(f"0030 43 1810 0{n} 00000000") for n in (1, 2))
ASK, ASK_OTHER = (MailboxRequest(COE, bytes.fromhex(f"0020 40 1810 0{n} 00000000")) for n in (1, 3))


@pytest.fixture
def judge():
    return ReplyJudge(COE)


def give(judge, data=YES, *, address=0, kind=COE, ask=ASK):
    return judge.answers(MailboxHeader(0, address, type=kind), data, ask)


def test_replies_are_told_by_protocol_and_content(judge):
    assert judge.next_address() == 0
    assert give(judge)
    assert give(judge, address=1001)
    assert not give(judge, NO)
    assert not give(judge, kind=FOE)
    assert give(judge, kind=ERR)


def test_after_a_time_out_requests_are_tagged_and_replies_told_by_the_tag(judge):
    judge.next_address()
    judge.expire(ASK)
    tag = judge.next_address()
    assert tag & 0x8000
    assert give(judge, address=tag)
    assert not give(judge, address=0)
    again = judge.next_address()
    assert again != tag
    assert not give(judge, address=tag)
    assert not give(judge, kind=ERR, address=tag)
    assert give(judge, kind=ERR, address=again)


def test_tags_go_round_and_are_never_0(judge):
    judge.expire(ASK)
    tags = {judge.next_address() for _ in range(0x5000)}
    assert min(tags) >= 0x8000
    assert max(tags) <= 0xFFFF


def test_without_echo_the_first_fitting_reply_is_the_late_one(judge):
    judge.expire(ASK)
    judge.next_address()
    assert not give(judge, NO)
    assert not give(judge)
    assert give(judge)


def test_without_echo_a_lost_reply_costs_one_more_time_out_and_not_two(judge):
    judge.expire(ASK)
    judge.next_address()
    assert not give(judge)
    judge.expire(ASK)
    judge.next_address()
    assert give(judge)


def test_a_late_reply_that_nobody_could_confuse_is_settled(judge):
    judge.expire(ASK)
    judge.next_address()
    assert not give(judge, ask=ASK_OTHER)
    assert give(judge)


def test_without_echo_a_mailbox_error_may_be_late_too(judge):
    judge.expire(ASK)
    judge.next_address()
    assert not give(judge, kind=ERR)
    assert give(judge, kind=ERR)


@pytest.mark.parametrize(
    ("kind", "data", "expected"),
    [
        (COE, encode_message(CoeService.EMERGENCY, bytes(8)), True),
        (COE, encode_message(CoeService.TX_PDO, bytes(8)), True),
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
def test_what_slaves_send_unasked(kind, data, expected):
    assert is_unsolicited(kind, data) is expected


LISTED = MailboxRequest(COE, bytes.fromhex("0080 01 00 0000 0100"))
PARTS = [bytes.fromhex(f"0080 {head} 00{n:02x}10") for n, head in
         enumerate(("82 00 0200 0100", "82 00 0100", "02 00 0000"))]  # fmt: skip
EMERGENCY = encode_message(CoeService.EMERGENCY, bytes(8))
REST = MailboxRequest(COE, LISTED.request[:6], listen=True)


def test_fragments_that_come_before_somebody_listens_are_kept(judge):
    judge.next_address()
    assert not judge.keep(PARTS[1])
    assert give(judge, PARTS[0], ask=LISTED)
    judge.took(PARTS[0])
    assert not judge.keep(EMERGENCY)
    assert judge.keep(PARTS[1])
    assert judge.keep(PARTS[2])
    assert not judge.keep(PARTS[2])
    assert [judge.take_kept(REST) for _ in range(3)] == [*PARTS[1:], None]


def test_what_was_kept_is_forgotten_with_the_next_request(judge):
    judge.took(PARTS[0])
    assert judge.keep(PARTS[1])
    judge.next_address()
    assert judge.take_kept(REST) is None
    assert not judge.keep(PARTS[1])


def test_not_all_is_kept(judge):
    judge.took(PARTS[0])
    assert sum(judge.keep(PARTS[1]) for _ in range(100)) == 64


def test_kept_messages_that_answer_something_else_are_dropped(judge):
    judge.took(PARTS[0])
    judge.keep(YES)
    assert judge.take_kept(REST) is None
