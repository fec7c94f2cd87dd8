from __future__ import annotations

import msgspec
import pytest

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.aoe_server import AoeServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.ads.answer import AmsAnswer
from eap.ams.fragment import Assembler, iter_fragments
from eap.codec.ams import AmsHeader, StateFlags, decode_packet, encode_packet
from eap.codec.mailbox import MailboxError, decode_frame
from tests.support.vectors import load_all

CAPTURED = {v.name.rpartition("/")[2]: v for v in load_all("ethernet")}
REQUEST, ANSWER = (
    bytes(decode_frame(CAPTURED[f"aoe_sdo_read_{name}"].frame)[1]) for name in ("req", "resp")
)


def answer(header: AmsHeader, data: bytes) -> AmsAnswer:
    assert header.command == 2
    assert data == bytes.fromhex("02f300000100181004000000")
    return AmsAnswer(bytes.fromhex("00000000 04000000 02000000"))


def test_request_is_answered_as_the_vector_has_it() -> None:
    server = AoeServer(answer, MailboxSizes())
    assert server.receive_message(REQUEST, 0) == [ANSWER]
    server.reset()
    assert server.messages_to_send(0) == []


def test_request_that_wants_no_answer_gets_none() -> None:
    header, data = decode_packet(REQUEST)
    quiet = AmsHeader(*[getattr(header, name) for name in header.__struct_fields__[:5]],
                      StateFlags.ADS | StateFlags.NO_RETURN)  # fmt: skip
    assert AoeServer(answer, MailboxSizes()).receive_message(encode_packet(quiet, data), 0) == []
    assert AoeServer(lambda header, data: None, MailboxSizes()).receive_message(REQUEST, 0) == []


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
        AoeServer(answer, MailboxSizes()).receive_message(packet, 0)
    assert caught.value.detail == detail


def test_handler_may_say_that_nobody_was_reached() -> None:
    server = AoeServer(lambda header, data: AmsAnswer(error_code=7), MailboxSizes())
    header, body = decode_packet(server.receive_message(REQUEST, 0)[0])
    assert (header.error_code, bytes(body)) == (7, b"")


def test_long_answer_goes_in_fragments() -> None:
    long = bytes(n % 251 for n in range(300))
    server = AoeServer(lambda header, data: AmsAnswer(long), MailboxSizes(128, 128))
    assembler = Assembler()
    answers = server.receive_message(REQUEST, 0)
    assert len(answers) == 4
    assert max(map(len, answers)) == 128 - 6
    packet = None
    for each in answers:
        assert packet is None
        packet, acknowledgement = assembler.receive(*decode_packet(each), 0)
        assert acknowledgement is None
    header, body = decode_packet(packet)
    assert bytes(body) == long
    assert header.state_flags == StateFlags.ADS | StateFlags.RESPONSE
    assert header.invoke_id == decode_packet(REQUEST)[0].invoke_id


def test_request_in_fragments_is_acknowledged_and_answered() -> None:
    forgotten = []
    server = AoeServer(answer, MailboxSizes(), forget=lambda: forgotten.append(1))
    *first, last = iter_fragments(REQUEST, 5, 12)
    for each in first:
        head, body = decode_packet(each)
        loud = msgspec.structs.replace(head, state_flags=StateFlags.ADS)
        ((back, nothing),) = map(decode_packet, server.receive_message(
            encode_packet(loud, body), 0))  # fmt: skip
        assert (back.state_flags, back.invoke_id, bytes(nothing)) == (5, head.invoke_id, b"")
    assert server.receive_message(last, 0) == [ANSWER]
    server.receive_message(first[0], 0)
    server.reset()
    assert forgotten == [1]
    with pytest.raises(MailboxRefusedError) as caught:
        server.receive_message(first[1], 0)
    assert caught.value.detail == MailboxError.INVALID_SIZE
