from __future__ import annotations

import pytest

from devicebus.errors import MailboxTimeoutError
from devicebus.mailbox.conversation import Conversation, MailboxRequest
from eap.codec.mailbox import MailboxType
from tools.fuzz.messages import answer_with, cut

VOE = MailboxType.VOE


def test_octets_are_cut_by_the_lengths_in_them() -> None:
    assert list(cut(b"\2ab\0\5xy")) == [b"ab", b"", b"xy"]
    assert list(cut(b"")) == []
    assert [len(item) for item in cut(bytes([48 + 3, 1, 2, 3]))] == [3]


def talk() -> Conversation[bytes]:
    yield MailboxRequest(VOE, b"", expects_reply=False)
    first = yield MailboxRequest(VOE, b"aaaaaa")
    second = yield MailboxRequest(VOE, b"")
    return first.data + second.data


def test_conversation_gets_what_it_accepts_and_every_other() -> None:
    assert answer_with(talk(), VOE, [b"aaaaaa", b"b"]) == b"aaaaaab"
    assert answer_with(talk(), VOE, [b"x", b"y", b"z"]) == b"yz"
    with pytest.raises(MailboxTimeoutError):
        answer_with(talk(), VOE, [b"aaaaaa"])
