"""How answers leave; what they say is in test_gateway."""

from __future__ import annotations

import pytest

from eap.aoe.way import Way
from eap.appliance.services.gateway.answering import Answering, Request, refusals
from eap.appliance.services.gateway.slave_session import Reply
from eap.codec.mailbox import MailboxHeader, MailboxType, decode_frame
from eap.gateway.ledger import Ledger
from eap.gateway.refusal import Reason

HERE = Way("udp:eap0", "127.0.0.1:1")
COE = MailboxType.COE


@pytest.fixture
def sent():
    return []


@pytest.fixture
def request_(sent):
    return Request(MailboxHeader(0, 0x9000, type=COE), bytes(10), HERE, sent.append)


def answering(*, is_silent: bool = False) -> tuple[Answering, Ledger]:
    ledger = Ledger()
    ledger.admit(HERE, b"request", 0)
    return Answering(ledger, "mill/bus0", is_silent=is_silent), ledger


def test_the_slaves_counter_goes_back_and_our_own_counts(request_, sent):
    desk, _ = answering()
    replies = [Reply(COE, b"a", 5), Reply(COE, b"b"), Reply(COE, b"c")]
    desk.answer(request_, 1001, 0x9000, replies, 1000)
    headers = [decode_frame(frame)[0] for frame in sent]
    assert [each.counter for each in headers] == [5, 1, 2]
    assert {each.address for each in headers} == {0x9000}
    (row,) = desk.tally.report()
    assert (row["address"], row["requests"], row["replies"]) == (1001, 1, 3)


@pytest.mark.parametrize("is_silent", [False, True])
def test_errors_are_counted_whether_they_are_sent_or_not(request_, sent, is_silent):
    desk, ledger = answering(is_silent=is_silent)
    desk.refuse(request_, Reason.CROWDED)
    desk.answer(request_, 0, 0, refusals(COE, bytes(10), Reason.DENIED), 0)
    desk.answer_dialect(request_, COE, b"no", Reason.DENIED, 0)
    assert len(sent) == (0 if is_silent else 3)
    assert ledger.counts_of(HERE).errors == 3
    desk.answer_dialect(request_, COE, b"yes", None, 0)
    assert decode_frame(sent[-1])[1] == b"yes"
    assert ledger.counts_of(HERE).errors == 3
