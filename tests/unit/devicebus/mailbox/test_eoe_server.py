from __future__ import annotations

from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.eoe_fragment import MAX_FRAME, Assembler, iter_fragments
from devicebus.mailbox.eoe_server import MAX_PENDING, EoeServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.eoe import EoeResult, IpSettings
from eap.codec.mailbox import MailboxError
from eap.errors import CodecError
from eap.ids import MacAddr
from tests.support.vectors import load

REQUEST, RESPONSE = [vector.octets[6:] for vector in load("eoe_mailbox")][:2]


def ask(server: EoeServer, octets: str) -> list[str]:
    return [answer.hex(" ") for answer in server.receive_message(bytes.fromhex(octets), 0)]


def drain(server: EoeServer) -> list[bytes]:
    assembler = Assembler()
    found = []
    while messages := server.messages_to_send(0):
        assert len(messages) == 1
        found.append(assembler.receive(messages[0]))
    return [frame for frame in found if frame is not None]


def test_captured_request_gets_the_captured_answer() -> None:
    server = EoeServer(MailboxSizes(1024, 1024))
    assert server.receive_message(REQUEST, 0) == [RESPONSE]
    assert server.settings == IpSettings.decode(REQUEST[4:])
    assert server.settings.mac == MacAddr.parse("02:01:05:30:03:e9")


def test_settings_that_are_not_given_stay() -> None:
    old = IpSettings(ip=IPv4Address("10.0.0.1"), name="old")
    server = EoeServer(MailboxSizes(), settings=old)
    assert ask(server, "0200 0000 02000000 0200000a") == ["03 00 00 00"]
    assert server.settings == IpSettings(ip=IPv4Address("10.0.0.2"), name="old")
    assert ask(server, "1600 0000")[0].startswith("17 00 00 00 22 00 00 00 02 00 00 0a 6f 6c 64")


def test_settings_that_are_refused_or_cut_change_nothing() -> None:
    server = EoeServer(MailboxSizes(), accept=lambda settings: EoeResult.NO_DHCP)
    assert ask(server, "0200 0000 02000000 0200000a") == ["03 00 02 02"]
    assert ask(server, "0200 0000 02000000 0200") == ["03 00 01 00"]
    assert server.settings == IpSettings()


@pytest.mark.parametrize(
    ("asked", "answer"), [("0400 0000", "05 00 01 04"), ("0800 0000", "09 00 01 04")]
)
def test_filters_are_not_there(asked: str, answer: str) -> None:
    assert ask(EoeServer(MailboxSizes()), asked) == [answer]


@pytest.mark.parametrize(
    ("octets", "detail"),
    [
        ("0200 00", MailboxError.SIZE_TOO_SHORT),
        ("0300 0000", MailboxError.SERVICE_NOT_SUPPORTED),
        ("0100 0000", MailboxError.SERVICE_NOT_SUPPORTED),
        ("0f00 0000", MailboxError.SERVICE_NOT_SUPPORTED),
    ],
)
def test_what_is_no_request_gets_a_mailbox_error(octets: str, detail: MailboxError) -> None:
    with pytest.raises(MailboxRefusedError) as caught:
        ask(EoeServer(MailboxSizes()), octets)
    assert caught.value.detail == detail


def test_frames_go_in_and_out() -> None:
    server = EoeServer(MailboxSizes(), receive_frame=lambda frame: [frame[::-1], frame])
    frame = bytes(range(200))
    for message in iter_fragments(frame, 0, 64):
        assert server.receive_message(message, 0) == []
    assert drain(server) == [frame[::-1], frame]


def test_frame_without_a_receiver_is_taken() -> None:
    server = EoeServer(MailboxSizes())
    (message,) = iter_fragments(b"frame", 0, 64)
    assert server.receive_message(message, 0) == []
    assert drain(server) == []


def test_frames_that_nobody_fetches_are_dropped_whole() -> None:
    server = EoeServer(MailboxSizes(64, 42))
    for _ in range(3):
        server.send_frame(bytes(30 * 32))
    assert server.dropped == 1
    assert len(drain(server)) == MAX_PENDING // 30
    server.send_frame(b"frame")
    server.reset()
    assert drain(server) == []


def test_frame_numbers_go_round() -> None:
    server = EoeServer(MailboxSizes())
    numbers = []
    for _ in range(17):
        server.send_frame(b"frame")
        (message,) = server.messages_to_send(0)
        numbers.append(message[3] >> 4)
    assert numbers == [*range(16), 0]


def test_frame_that_cannot_be_sent_is_an_error_of_the_caller_or_dropped() -> None:
    server = EoeServer(MailboxSizes(), receive_frame=lambda frame: [bytes(MAX_FRAME + 1)])
    with pytest.raises(CodecError):
        server.send_frame(b"")
    (message,) = iter_fragments(b"frame", 0, 64)
    assert server.receive_message(message, 0) == []
    assert server.dropped == 1


@given(st.binary(max_size=60))
def test_any_octets_are_answered_or_refused(noise: bytes) -> None:
    try:
        answers = EoeServer(MailboxSizes()).receive_message(noise, 0)
    except MailboxRefusedError:
        return
    assert len(answers) <= 1
