from __future__ import annotations

import pytest

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.voe_server import VoeServer
from eap.codec.mailbox import MailboxError

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
