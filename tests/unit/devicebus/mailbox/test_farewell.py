"""What ends a transfer for somebody who has left."""

from __future__ import annotations

import pytest

from devicebus.mailbox import coe_client
from devicebus.mailbox.farewell import FAREWELLS
from tests.support.loopbus import LoopBus


@pytest.mark.parametrize("kind", FAREWELLS)
def test_slave_without_a_transfer_ignores_it(kind):
    def leave(sizes):
        del sizes
        message = yield FAREWELLS[kind]
        return message.data

    with LoopBus("drive").session() as bus:
        drive = bus.find("drive")
        assert bus.converse(drive, leave, "farewell") == b""
        vendor = bus.converse(drive, lambda _: coe_client.upload(0x1018, 1), "vendor")
    assert vendor == b"\x5a\x0e\0\0"
