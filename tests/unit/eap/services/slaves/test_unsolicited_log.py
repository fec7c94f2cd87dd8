from __future__ import annotations

import pytest

from devicebus.master.mailboxes import Unsolicited
from eap.codec.mailbox import MailboxType
from eap.runtime.engine_messages import UnsolicitedMessage
from eap.services.local_bus import log_unsolicited_pdos
from tests.support.busads import play, until


@pytest.mark.parametrize(
    ("octets", "text"),
    [
        ("0340 0102", "CoE TxPDO 3 (2 bytes), not used"),
        ("0050 01", "CoE RxPDO 0 (1 bytes), not used"),
        ("0160", "CoE TxPDO remote request 1 (0 bytes), not answered"),
        ("0270", "CoE RxPDO remote request 2 (0 bytes), not answered"),
    ],
)
def test_pdo_of_a_slave_is_named(octets, text, caplog):
    async def scene(client, engine):
        log_unsolicited_pdos(client.bus)
        for data in (bytes(10), b"", bytes.fromhex("0010") + bytes(8), bytes.fromhex(octets)):
            engine.tell(UnsolicitedMessage(0, Unsolicited(1001, MailboxType.COE, data)))
        engine.tell(UnsolicitedMessage(0, Unsolicited(1001, MailboxType.EOE, b"\0\x40")))

        async def is_logged():
            return bool(caplog.records)

        await until(is_logged)
        await client.bus.view.current()
        (record,) = caplog.records
        assert f"slave 1001 sends by mailbox: {text}" in record.getMessage()

    play(scene)
