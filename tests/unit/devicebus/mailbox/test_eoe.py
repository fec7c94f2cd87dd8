from __future__ import annotations

from contextlib import suppress
from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import BusError, EoeError, MailboxProtocolError, MailboxRefusedError
from devicebus.mailbox import eoe
from devicebus.mailbox.eoe import MAX_FRAME, MAX_PENDING, EoeServer, FrameAssembler, iter_fragments
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.eoe import EoeHeader, EoeResult, FragmentWord, IpSettings
from eap.codec.mailbox import MailboxError, MailboxType
from eap.errors import CodecError
from eap.ids import MacAddr
from tests.support.mailbox import open_line, run_with, talk_to
from tests.support.vectors import load

CAPTURED = [vector.octets[6:] for vector in load("eoe_mailbox")][2:]
FRAME = bytes(range(100))


def fragments(frame: bytes = FRAME, number: int = 0, data_size: int = 40) -> list[bytes]:
    return list(iter_fragments(frame, number, data_size))


def receive(assembler: FrameAssembler, *messages: bytes) -> list[bytes]:
    found = [assembler.receive(message) for message in messages]
    return [frame for frame in found if frame is not None]


@pytest.mark.parametrize("number", range(4))
def test_eoe_captured_frame_round_trip(number: int) -> None:
    (frame,) = receive(FrameAssembler(), CAPTURED[number])
    assert frame == CAPTURED[number][4:]
    assert fragments(frame, number, 1014) == [CAPTURED[number]]


def test_eoe_fragments_as_the_vector() -> None:
    words = [message[:4].hex(" ") for message in fragments(number=5, data_size=40)]
    assert words == ["00 00 00 51", "00 00 41 50", "00 00 82 50", "00 01 c3 50"]
    assert [len(message) - 4 for message in fragments(data_size=70)] == [64, 36]


@given(st.binary(min_size=1, max_size=MAX_FRAME), st.integers(32, 1600), st.integers(0, 15))
def test_frame_survives_its_fragments(frame: bytes, room: int, number: int) -> None:
    messages = fragments(frame, number, room)
    assert all(len(message) <= room + 4 for message in messages)
    assert receive(FrameAssembler(), *messages) == [frame]


def test_eoe_short_frame_in_a_small_mailbox() -> None:
    assert receive(FrameAssembler(), *fragments(b"short", data_size=6)) == [b"short"]


@pytest.mark.parametrize(
    ("frame", "room", "reason"),
    [
        (b"", 100, "a frame of 0 bytes"),
        (bytes(MAX_FRAME + 1), 100, "a frame of 1523 bytes"),
        (bytes(40), 31, "fragments of 31 bytes"),
    ],
)
def test_frame_that_cannot_be_sent(frame: bytes, room: int, reason: str) -> None:
    with pytest.raises(CodecError, match=reason):
        fragments(frame, data_size=room)


def test_eoe_appended_time_is_no_part_of_the_frame() -> None:
    header = EoeHeader(0, last=1, time_appended=1).encode() + FragmentWord(0, 1, 0).encode()
    assert receive(FrameAssembler(), header + b"frame" + b"time") == [b"frame"]
    with pytest.raises(CodecError, match="time stamp announced"):
        FrameAssembler().receive(header + b"tim")


@pytest.mark.parametrize("missing", range(4))
def test_frame_with_a_missing_fragment_is_dropped(missing: int) -> None:
    assembler = FrameAssembler()
    messages = fragments()
    del messages[missing]
    assert receive(assembler, *messages, *fragments(number=1)) == [FRAME]
    assert assembler.dropped == 1


def test_fragments_of_two_frames_do_not_mix() -> None:
    assembler = FrameAssembler()
    assert receive(assembler, *fragments()[:2], *fragments(number=1)[2:]) == []
    assert assembler.dropped == 2


def test_offset_that_does_not_fit_drops_the_frame() -> None:
    assembler = FrameAssembler()
    first, second = fragments(bytes(64), data_size=32)
    wrong = second[:2] + FragmentWord(1, 2, 0).encode() + second[4:]
    assert receive(assembler, first, wrong) == []
    assert assembler.dropped == 1


def test_eoe_reset_discards_the_incomplete_frame() -> None:
    assembler = FrameAssembler()
    first, last = fragments(bytes(64), data_size=32)
    assembler.receive(first)
    assembler.reset()
    assert receive(assembler, last) == []


@given(st.lists(st.binary(min_size=4, max_size=700), max_size=20))
def test_eoe_any_fragments_end_in_frames_or_codec_error(noise: list[bytes]) -> None:
    assembler = FrameAssembler()
    for octets in noise:
        message = bytes((0, octets[1])) + octets[2:]
        try:
            frame = assembler.receive(message)
        except CodecError:
            continue
        assert frame is None or len(frame) <= MAX_FRAME


EOE = MailboxType.EOE
SET_IP, SET_IP_RESPONSE, SET_IP_FRAME = [vector.octets[6:] for vector in load("eoe_mailbox")][:3]


def test_ip_settings_are_sent_as_captured() -> None:
    settings = IpSettings.decode(SET_IP[4:])
    _, asked = run_with(EOE, eoe.set_ip(settings), [SET_IP_FRAME, SET_IP_RESPONSE])
    assert asked == [SET_IP]


def test_settings_go_to_our_slave_and_back() -> None:
    sizes = MailboxSizes()
    line = open_line(EOE, EoeServer(sizes), sizes)
    settings = IpSettings(
        MacAddr.parse("02:00:00:00:00:01"), IPv4Address("10.0.0.1"), name="axis 1"
    )
    line.run(eoe.set_ip(settings))
    assert line.run(eoe.get_ip()) == settings


def test_eoe_refusal_is_raised_with_its_result() -> None:
    with pytest.raises(EoeError, match=r"EoE set IP: DHCP is not supported \(0x0202\)") as caught:
        talk_to(EOE, eoe.set_ip(IpSettings()), "0300 0202")
    assert caught.value.result == EoeResult.NO_DHCP


@pytest.mark.parametrize("answer", ["", "07", "0700 0000", "0700 0000 02000000 0a"])
def test_answer_that_breaks_the_protocol(answer: str) -> None:
    with pytest.raises(MailboxProtocolError, match="EoE get IP"):
        talk_to(EOE, eoe.get_ip(), answer)


@given(st.lists(st.binary(max_size=20), max_size=5))
def test_eoe_any_answers_end_in_settings_or_an_error(noise: list[bytes]) -> None:
    # A mailbox never carries an empty message, so a slave cannot send one.
    with suppress(BusError):
        talk_to(EOE, eoe.get_ip(), *[b"\7" + octets for octets in noise])


IP_REQUEST, IP_RESPONSE = [vector.octets[6:] for vector in load("eoe_mailbox")][:2]


def ask(server: EoeServer, octets: str) -> list[str]:
    return [answer.hex(" ") for answer in server.receive_message(bytes.fromhex(octets), 0)]


def drain(server: EoeServer) -> list[bytes]:
    assembler = FrameAssembler()
    found = []
    while messages := server.messages_to_send(0):
        assert len(messages) == 1
        found.append(assembler.receive(messages[0]))
    return [frame for frame in found if frame is not None]


def test_eoe_server_answers_the_captured_request() -> None:
    server = EoeServer(MailboxSizes(1024, 1024))
    assert server.receive_message(IP_REQUEST, 0) == [IP_RESPONSE]
    assert server.settings == IpSettings.decode(IP_REQUEST[4:])
    assert server.settings.mac == MacAddr.parse("02:01:05:30:03:e9")


def test_settings_that_are_not_given_stay() -> None:
    old = IpSettings(ip=IPv4Address("10.0.0.1"), name="old")
    server = EoeServer(MailboxSizes(), settings=old)
    assert ask(server, "0200 0000 02000000 0200000a") == ["03 00 00 00"]
    assert server.settings == IpSettings(ip=IPv4Address("10.0.0.2"), name="old")
    assert ask(server, "1600 0000")[0].startswith("17 00 00 00 22 00 00 00 02 00 00 0a 6f 6c 64")


def test_eoe_server_refused_settings_change_nothing() -> None:
    server = EoeServer(MailboxSizes(), accept=lambda settings: EoeResult.NO_DHCP)
    assert ask(server, "0200 0000 02000000 0200000a") == ["03 00 02 02"]
    assert ask(server, "0200 0000 02000000 0200") == ["03 00 01 00"]
    assert server.settings == IpSettings()


@pytest.mark.parametrize(
    ("asked", "answer"), [("0400 0000", "05 00 01 04"), ("0800 0000", "09 00 01 04")]
)
def test_eoe_server_has_no_filters(asked: str, answer: str) -> None:
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
def test_eoe_answers_other_messages_with_a_mailbox_error(octets: str, detail: MailboxError) -> None:
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


def test_eoe_server_drops_whole_frames_beyond_the_queue() -> None:
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
def test_eoe_any_bytes_are_answered_or_refused(noise: bytes) -> None:
    try:
        answers = EoeServer(MailboxSizes()).receive_message(noise, 0)
    except MailboxRefusedError:
        return
    assert len(answers) <= 1
