from __future__ import annotations

import pytest

from devicebus.errors import MailboxProtocolError
from devicebus.mailbox.conversation import (
    Conversation,
    MailboxMessage,
    MailboxRequest,
    Progress,
    reading,
)
from eap.codec.mailbox import MailboxHeader, MailboxType


def twice() -> Conversation[bytes]:
    first = yield MailboxRequest(MailboxType.COE, b"a")
    second = yield MailboxRequest(MailboxType.COE, b"a", listen=True)
    return first.data + second.data


def test_a_conversation_is_resumed_with_each_reply() -> None:
    talk = twice()
    ask = next(talk)
    assert (ask.request, ask.listen) == (b"a", False)
    ask = talk.send(MailboxMessage(MailboxType.COE, b"1"))
    assert (ask.request, ask.listen) == (b"a", True)
    with pytest.raises(StopIteration) as end:
        talk.send(MailboxMessage(MailboxType.COE, b"2"))
    assert end.value.value == b"12"


def test_progress_starts_at_zero() -> None:
    assert (Progress().done, Progress().total, Progress(5).total) == (0, None, 5)


def test_rate_is_that_of_the_last_seconds() -> None:
    progress = Progress(4000)
    second = 1_000_000_000
    assert progress.rate(second) == 0
    progress.done = 100
    assert progress.rate(2 * second) == 100
    progress.done = 500
    assert progress.rate(3 * second) == 250
    assert progress.rate(3 * second) == 250
    progress.done = 600
    assert progress.rate(5 * second) == 50
    assert progress.rate(9 * second) == 0


def test_reading_converts_codec_errors() -> None:
    broken = pytest.raises(MailboxProtocolError, match="answer of S1: MailboxHeader at offset 0")
    with broken, reading("answer of S1"):
        MailboxHeader.decode(b"")
