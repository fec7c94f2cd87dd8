from __future__ import annotations

import pytest

from devicebus.errors import MailboxTimeoutError
from devicebus.mailbox import voe_client
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.voe_server import VoeServer
from eap.codec.mailbox import MailboxType
from tests.support.mailbox import open_line, run_with, talk_to

VOE = MailboxType.VOE


def test_exchange_takes_the_answer_of_its_vendor_and_type() -> None:
    answers = ["03000000 3412 ff", "02000000 3512 ff", "0200", "02000000 3412 0708"]
    answer, asked = run_with(VOE, voe_client.exchange(2, 0x1234, b"\1"), answers)
    assert (answer, asked) == (b"\7\x08", [bytes.fromhex("02000000 3412 01")])


def test_exchange_with_our_echo() -> None:
    line = open_line(VOE, VoeServer(), MailboxSizes())
    assert line.run(voe_client.exchange(0xFFFFFFFF, 0xFFFF, b"hello")) == b"hello"


def test_nobody_answers() -> None:
    with pytest.raises(MailboxTimeoutError):
        talk_to(VOE, voe_client.exchange(2, 1, b""), "02000000 02")


def test_send_waits_for_nothing() -> None:
    _, asked = run_with(VOE, voe_client.send(2, 1, b"\1"), [])
    assert asked == [bytes.fromhex("02000000 0100 01")]
