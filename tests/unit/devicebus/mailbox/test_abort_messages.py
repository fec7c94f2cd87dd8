"""Abort messages for transfers whose client has left."""

from __future__ import annotations

import pytest

from devicebus.mailbox import coe_client
from devicebus.mailbox.conversation import ABORT_MESSAGES
from tests.support.loopbus import LoopBus


@pytest.mark.parametrize("kind", ABORT_MESSAGES)
def test_abort_message_is_ignored_by_a_slave_without_a_transfer(kind):
    def leave(sizes):
        del sizes
        message = yield ABORT_MESSAGES[kind]
        return message.data

    with LoopBus("drive").session() as bus:
        drive = bus.find("drive")
        assert bus.converse(drive, leave, "abort") == b""
        vendor = bus.converse(drive, lambda _: coe_client.upload(0x1018, 1), "vendor")
    assert vendor == b"\x5a\x0e\0\0"
