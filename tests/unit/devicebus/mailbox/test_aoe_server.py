from __future__ import annotations

import pytest

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.aoe_server import AoeServer
from eap.codec.ams import AmsHeader, StateFlags, decode_packet, encode_packet
from eap.codec.mailbox import MailboxError, decode_frame
from tests.support.vectors import load_all

CAPTURED = {v.name.rpartition("/")[2]: v for v in load_all("ethernet")}
REQUEST, ANSWER = (
    bytes(decode_frame(CAPTURED[f"aoe_sdo_read_{name}"].frame)[1]) for name in ("req", "resp")
)


def answer(header: AmsHeader, data: bytes) -> bytes | None:
    assert header.command == 2
    assert data == bytes.fromhex("02f300000100181004000000")
    return bytes.fromhex("00000000 04000000 02000000")


def test_request_is_answered_as_the_vector_has_it() -> None:
    server = AoeServer(answer)
    assert server.receive_message(REQUEST, 0) == [ANSWER]
    server.reset()
    assert server.messages_to_send(0) == []


def test_request_that_wants_no_answer_gets_none() -> None:
    header, data = decode_packet(REQUEST)
    quiet = AmsHeader(*[getattr(header, name) for name in header.__struct_fields__[:5]],
                      StateFlags.ADS | StateFlags.NO_RETURN)  # fmt: skip
    assert AoeServer(answer).receive_message(encode_packet(quiet, data), 0) == []
    assert AoeServer(lambda header, data: None).receive_message(REQUEST, 0) == []


@pytest.mark.parametrize(
    ("packet", "detail"),
    [
        (REQUEST[:31], MailboxError.SIZE_TOO_SHORT),
        (REQUEST[:-1], MailboxError.SIZE_TOO_SHORT),
        (ANSWER, MailboxError.SERVICE_NOT_SUPPORTED),
    ],
)
def test_what_is_no_request_gets_a_mailbox_error(packet: bytes, detail: MailboxError) -> None:
    with pytest.raises(MailboxRefusedError) as caught:
        AoeServer(answer).receive_message(packet, 0)
    assert caught.value.detail == detail
