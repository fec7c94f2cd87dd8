"""Steps of a conversation as frames; whole ones are in test_client."""

from __future__ import annotations

import pytest

from devicebus.errors import MailboxRefusedError, MailboxTimeoutError
from devicebus.mailbox import coe_client, foe_client, voe_client
from devicebus.mailbox.conversation import Ask
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.mailbox import MailboxType
from eap.gateway.dialogue import Dialogue

REPLY = bytes.fromhex("10 50 0a00 e903 00 23 0030 43 1810 01 02000000")


def dialogue(address: int = 1001, counter: int = 0) -> Dialogue[bytes]:
    return Dialogue(coe_client.upload(0x1018, 1), address, counter)


def test_request_and_reply() -> None:
    one = dialogue(counter=7)
    assert one.frame == bytes.fromhex("10 50 0a00 e903 00 13 0020 40 1810 01 00000000")
    assert one.receive(REPLY)
    assert (one.is_done, one.result(), one.counter, one.frame) == (True, b"\2\0\0\0", 1, None)
    assert not one.receive(REPLY)


@pytest.mark.parametrize(
    "frame",
    [
        REPLY[:-1],
        b"",
        REPLY[:4] + b"\xea\3" + REPLY[6:],
        REPLY[:13] + b"\2" + REPLY[14:],
        REPLY[:7] + b"\x24" + REPLY[8:],
    ],
    ids=["cut", "empty", "address", "subindex", "type"],
)
def test_what_is_no_reply_is_passed_over(frame) -> None:
    one = dialogue()
    assert not one.receive(frame)
    assert not one.is_done


def test_errors_end_it() -> None:
    one = dialogue()
    assert one.receive(bytes.fromhex("0a50 0400 e903 00 00 0100 0200"))
    with pytest.raises(MailboxRefusedError, match="slave 1001: mailbox error UNSUPPORTED_PROTOCOL"):
        one.result()
    one = dialogue()
    assert one.receive(bytes.fromhex("0650 0000 e903 00 00"))
    with pytest.raises(MailboxRefusedError, match="without a reason"):
        one.result()
    one = dialogue()
    one.expire("a:1 was silent")
    with pytest.raises(MailboxTimeoutError, match="no answer from address 1001: a:1 was silent"):
        one.result()


def test_what_nobody_answers_goes_on_when_it_is_sent() -> None:
    one = Dialogue(voe_client.send(1, 2, b"x"), 1001)
    assert not one.expects_reply
    one.sent()
    assert one.is_done
    assert one.result() is None


def test_listening_and_delays() -> None:
    def talk():
        first = yield Ask(MailboxType.VOE, b"123456", delay_ns=5)
        more = yield Ask(MailboxType.VOE, b"123456", listen=True)
        return first.data + more.data

    one = Dialogue(talk(), 1)
    assert (one.delay_ns, one.expects_reply) == (5, True)
    frame = bytes.fromhex("0d50 0700 0100 00 1f") + b"1234567"
    assert one.receive(frame)
    assert one.frame is None
    one.sent()
    assert one.receive(frame)
    assert one.result() == b"12345671234567"


def test_a_conversation_that_takes_an_error_goes_on() -> None:
    def careful():
        try:
            yield Ask(MailboxType.VOE, b"123456")
        except MailboxTimeoutError:
            return "late"

    one = Dialogue(careful(), 1)
    one.expire("")
    assert one.result() == "late"

    def patient():
        try:
            yield Ask(MailboxType.VOE, b"123456")
        except MailboxTimeoutError:
            yield Ask(MailboxType.VOE, b"again!")

    one = Dialogue(patient(), 1)
    one.expire("")
    assert one.frame is not None
    assert one.frame.endswith(b"again!")
    one.close()
    assert one.is_done


def test_who_leaves_in_the_middle_frees_the_slave() -> None:
    files = Dialogue(foe_client.read("f", bytes, MailboxSizes(128, 128)), 1001, 3)
    farewell = files.close()
    assert farewell is not None
    assert (files.is_done, files.counter) == (True, 5)
    assert farewell == bytes.fromhex("0c50 0600 e903 00 54 0500 00800000")
    assert files.close() is None
    done = dialogue()
    done.receive(REPLY)
    assert done.close() is None
    assert Dialogue(voe_client.exchange(1, 2, b""), 1001).close() is None, "nothing stays open"
