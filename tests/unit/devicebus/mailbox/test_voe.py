from __future__ import annotations

import pytest

from devicebus.errors import MailboxRefusedError, MailboxTimeoutError
from devicebus.mailbox import voe
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.voe import VoeServer
from eap.codec.mailbox import MailboxError, MailboxType
from tests.support.mailbox import open_line, run_with, talk_to

VOE = MailboxType.VOE


def test_voe_exchange_returns_the_answer_of_vendor_and_type() -> None:
    answers = ["03000000 3412 ff", "02000000 3512 ff", "0200", "02000000 3412 0708"]
    answer, asked = run_with(VOE, voe.exchange(2, 0x1234, b"\1"), answers)
    assert (answer, asked) == (b"\7\x08", [bytes.fromhex("02000000 3412 01")])


def test_exchange_with_our_echo() -> None:
    line = open_line(VOE, VoeServer(), MailboxSizes())
    assert line.run(voe.exchange(0xFFFFFFFF, 0xFFFF, b"hello")) == b"hello"


def test_voe_server_without_answer() -> None:
    with pytest.raises(MailboxTimeoutError):
        talk_to(VOE, voe.exchange(2, 1, b""), "02000000 02")


def test_voe_send_has_no_reply() -> None:
    _, asked = run_with(VOE, voe.send(2, 1, b"\1"), [])
    assert asked == [bytes.fromhex("02000000 0100 01")]


REQUEST = bytes.fromhex("02000000 3412 0102")


def test_slave_without_a_handler_echoes() -> None:
    server = VoeServer()
    assert server.receive_message(REQUEST, 0) == [REQUEST]
    server.reset()
    assert server.messages_to_send(0) == []


def test_handler_answers_or_not() -> None:
    server = VoeServer(lambda vendor, kind, data: bytes((vendor, kind >> 8)) if data else None)
    assert server.receive_message(REQUEST, 0) == [bytes.fromhex("02000000 3412 0212")]
    assert server.receive_message(REQUEST[:6], 0) == []


def test_message_without_a_header_is_too_short() -> None:
    with pytest.raises(MailboxRefusedError) as caught:
        VoeServer().receive_message(REQUEST[:5], 0)
    assert caught.value.detail == MailboxError.SIZE_TOO_SHORT
