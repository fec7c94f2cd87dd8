"""Requests of a gateway client as frames; any order of them is in test_conversations_machine."""

from __future__ import annotations

import pytest

from devicebus.errors import MailboxRefusedError, MailboxTimeoutError
from devicebus.mailbox import coe_client, foe_client, soe_client, voe
from devicebus.mailbox.conversation import MailboxMessage, MailboxRequest, drive
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.mailbox import MailboxHeader, MailboxType, encode_frame
from eap.codec.soe import Idn
from eap.errors import CodecError
from eap.gateway.conversations import GatewayConversation, GatewayConversations, PendingRequest

REQUEST = bytes.fromhex("10 50 0a00 e903 00 13 0020 40 1810 01 00000000")
REPLY = bytes.fromhex("10 50 0a00 e903 00 23 0030 43 1810 01 02000000")
REFUSED = bytes.fromhex("0a50 0400 e903 00 00 0100 0200")
UPLOAD = next(coe_client.upload(0x1018, 1))
VENDOR = next(voe.exchange(1, 2, b"a"))
READ = next(foe_client.read("f", bytes, MailboxSizes()))
TIMEOUT_NS, TRIES = 100, 3


@pytest.fixture
def core() -> GatewayConversations:
    return GatewayConversations(timeout_ns=TIMEOUT_NS, tries=TRIES, silence="a:1 was silent")


def begin(core: GatewayConversations, ask: MailboxRequest, now_ns: int = 0) -> PendingRequest:
    return core.request(GatewayConversation(1001), ask, now_ns)


def reply_of(kind: MailboxType, body: bytes, address: int = 1001) -> bytes:
    return encode_frame(MailboxHeader(0, address, type=kind), body)


def test_request_is_sent_and_ends_with_its_reply(core) -> None:
    request = begin(core, UPLOAD)
    assert core.frames_to_send(0) == [REQUEST]
    assert core.frames_to_send(0) == []
    core.receive_frame(REPLY, 1)
    assert (request.result().data, request.result().counter) == (REPLY[8:], 2)
    assert (core.next_event(), core.next_event()) == (request, None)
    core.receive_frame(REPLY, 2)
    assert core.next_event() is None
    assert core.next_timeout() is None


def test_counter_of_an_address_runs_from_1_to_7(core) -> None:
    place = GatewayConversation(1001)
    counters = []
    for _ in range(8):
        core.request(place, UPLOAD, 0)
        (frame,) = core.frames_to_send(0)
        counters.append(frame[7] >> 4)
        core.receive_frame(REPLY, 0)
    assert counters == [1, 2, 3, 4, 5, 6, 7, 1]


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
def test_frame_that_answers_nothing_is_dropped(core, frame) -> None:
    request = begin(core, UPLOAD)
    core.receive_frame(frame, 0)
    assert not request.is_done


def test_mailbox_error_ends_the_only_request(core) -> None:
    request = begin(core, UPLOAD)
    core.receive_frame(REFUSED, 0)
    with pytest.raises(MailboxRefusedError, match="slave 1001: mailbox error UNSUPPORTED_PROTOCOL"):
        request.result()
    master = core.request(GatewayConversation(0), UPLOAD, 0)
    core.receive_frame(bytes.fromhex("0650 0000 0000 00 00"), 0)
    with pytest.raises(MailboxRefusedError, match="the master: mailbox error without a reason"):
        master.result()


def test_request_without_a_reply_is_sent_again_and_ends_with_a_timeout(core) -> None:
    request = begin(core, UPLOAD)
    for number in range(TRIES):
        assert core.frames_to_send(0) == [REQUEST]
        core.handle_timeout(number * TIMEOUT_NS + 1)
        assert core.frames_to_send(0) == []
        due_ns = (number + 1) * TIMEOUT_NS
        assert core.next_timeout() == due_ns
        core.handle_timeout(due_ns)
    with pytest.raises(MailboxTimeoutError, match="no answer from address 1001: a:1 was silent"):
        request.result()


def test_request_that_expects_no_reply_ends_when_it_is_sent(core) -> None:
    request = begin(core, next(voe.send(1, 2, b"x")))
    assert len(core.frames_to_send(0)) == 1
    assert request.result().data == b""


def test_delay_passes_before_a_request_is_sent(core) -> None:
    begin(core, MailboxRequest(MailboxType.VOE, b"123456", delay_ns=5))
    assert core.frames_to_send(0) == []
    assert core.next_timeout() == 5
    core.handle_timeout(5)
    assert len(core.frames_to_send(5)) == 1


def test_listening_request_sends_nothing_and_ends_with_the_next_message(core) -> None:
    place = GatewayConversation(1001)
    message = reply_of(MailboxType.VOE, b"1234567")
    core.request(place, MailboxRequest(MailboxType.VOE, b"123456"), 0)
    core.receive_frame(message, 0)
    assert len(core.frames_to_send(0)) == 1
    listening = core.request(place, MailboxRequest(MailboxType.VOE, b"123456", listen=True), 0)
    assert (core.frames_to_send(0), core.next_timeout()) == ([], TIMEOUT_NS * TRIES)
    core.receive_frame(message, 0)
    assert listening.result().data == b"1234567"
    again = core.request(place, MailboxRequest(MailboxType.VOE, b"123456", listen=True), 0)
    core.handle_timeout(TIMEOUT_NS * TRIES)
    with pytest.raises(MailboxTimeoutError):
        again.result()


def test_fragments_that_come_before_they_are_listened_for_are_kept(core) -> None:
    place = GatewayConversation(1001)
    bodies = [bytes.fromhex(body) for body in ("0a40 0200 01", "0a40 0100 02", "0240 1000 03")]

    def exchange(ask: MailboxRequest) -> MailboxMessage:
        request = core.request(place, ask, 0)
        for body in bodies:
            core.receive_frame(reply_of(MailboxType.SOE, body), 0)
        bodies.clear()
        return request.result()

    assert drive(soe_client.read(Idn.of(16)), exchange) == b"\1\2\3"


def test_second_conversation_by_the_same_protocol_waits_for_the_end_of_the_first(core) -> None:
    first, second = GatewayConversation(1001), GatewayConversation(1001)
    request = core.request(first, UPLOAD, 0)
    waiting = core.request(second, UPLOAD, 0)
    core.receive_frame(REPLY, 0)
    request.result()
    assert len(core.frames_to_send(0)) == 1
    assert not waiting.is_done
    core.close(first, 0)
    assert len(core.frames_to_send(0)) == 1
    core.receive_frame(REPLY, 0)
    assert waiting.is_done


def test_next_request_waits_for_the_late_reply_that_would_fit_it(core) -> None:
    place = GatewayConversation(1001)
    core.request(place, UPLOAD, 0)
    core.handle_timeout(TIMEOUT_NS)
    core.receive_frame(REPLY, TIMEOUT_NS)
    assert len(core.frames_to_send(0)) == 2
    other = core.request(place, next(coe_client.upload(0x1018, 2)), TIMEOUT_NS)
    assert len(core.frames_to_send(0)) == 1, "the late reply is none to this one"
    core.receive_frame(REPLY[:13] + b"\2" + REPLY[14:], TIMEOUT_NS)
    assert other.is_done
    again = core.request(place, UPLOAD, TIMEOUT_NS)
    assert core.next_timeout() == 2 * TIMEOUT_NS
    assert core.frames_to_send(0) == []
    core.receive_frame(REPLY, TIMEOUT_NS)
    assert len(core.frames_to_send(0)) == 1, "nothing is late any more"
    assert not again.is_done


def test_mailbox_error_beside_two_requests_counts_for_none(core) -> None:
    coe, voe = begin(core, UPLOAD), begin(core, VENDOR)
    core.frames_to_send(0)
    core.receive_frame(REFUSED, 0)
    assert not coe.is_done
    assert not voe.is_done
    file = begin(core, READ)
    assert core.frames_to_send(0) == [], "nothing new until the error has its request"
    core.receive_frame(REPLY, 0)
    assert coe.is_done
    (again,) = core.frames_to_send(0)
    assert again[7] & 15 == MailboxType.VOE
    core.receive_frame(REFUSED, 0)
    with pytest.raises(MailboxRefusedError):
        voe.result()
    assert [frame[7] & 15 for frame in core.frames_to_send(0)] == [MailboxType.FOE]
    assert not file.is_done


def test_two_requests_of_which_none_is_answered_are_sent_again_one_by_one(core) -> None:
    begin(core, UPLOAD)
    begin(core, VENDOR)
    core.frames_to_send(0)
    core.receive_frame(REFUSED, 0)
    sent = []
    for now_ns in range(0, 20 * TIMEOUT_NS, TIMEOUT_NS // 2):
        core.handle_timeout(now_ns)
        sent += [(now_ns // TIMEOUT_NS, frame[7] & 15) for frame in core.frames_to_send(now_ns)]
    assert sent == [(at, 15) for at in (1, 2, 3)] + [(at, 3) for at in (4, 5, 6)]
    assert core.next_timeout() is None


def test_conversation_that_is_broken_off_frees_the_slave(core) -> None:
    place = GatewayConversation(1001)
    core.request(place, READ, 0)
    core.frames_to_send(0)
    core.close(place, 0)
    assert core.frames_to_send(0) == [bytes.fromhex("0c50 0600 e903 00 24 0500 00800000")]
    core.close(place, 0)
    assert core.frames_to_send(0) == []


@pytest.mark.parametrize("ask", [UPLOAD, VENDOR], ids=["ended", "nothing stays open"])
def test_conversation_that_ends_sends_nothing_more(core, ask) -> None:
    place = GatewayConversation(1001)
    request = core.request(place, ask, 0)
    if ask is UPLOAD:
        core.receive_frame(REPLY, 0)
        request.result()
    core.frames_to_send(0)
    core.close(place, 0)
    assert core.frames_to_send(0) == []


def test_conversation_that_never_had_its_turn_leaves_without_a_word(core) -> None:
    begin(core, READ)
    second = GatewayConversation(1001)
    core.request(second, READ, 0)
    core.frames_to_send(0)
    core.close(second, 0)
    core.close(GatewayConversation(7), 0)
    assert core.frames_to_send(0) == []


def test_message_too_long_for_a_frame_is_refused(core) -> None:
    with pytest.raises(CodecError):
        begin(core, MailboxRequest(MailboxType.VOE, bytes(2042)))


def test_mailbox_error_beside_late_replies_counts_for_the_request(core) -> None:
    place = GatewayConversation(1001)
    core.request(place, UPLOAD, 0)
    core.handle_timeout(TIMEOUT_NS)
    core.receive_frame(REPLY, TIMEOUT_NS)
    vendor = begin(core, VENDOR, TIMEOUT_NS)
    core.receive_frame(REFUSED, TIMEOUT_NS)
    with pytest.raises(MailboxRefusedError):
        vendor.result()


def test_second_mailbox_error_beside_two_requests_gives_no_more_tries(core) -> None:
    requests = [begin(core, UPLOAD), begin(core, VENDOR)]
    for _ in range(3):
        core.receive_frame(REFUSED, 0)
    assert [request.tries for request in requests] == [TRIES + 1] * 2


def test_fragments_of_another_reply_that_came_early_are_left_out(core) -> None:
    place = GatewayConversation(1001)
    named = MailboxRequest(MailboxType.SOE, bytes.fromhex("01401000"))
    core.request(place, named, 0)
    for body in ("0a400100 01", "2a401000 02", "02401000 03"):
        core.receive_frame(reply_of(MailboxType.SOE, bytes.fromhex(body)), 0)
    cut = MailboxRequest(MailboxType.SOE, bytes.fromhex("0140"), listen=True)
    listening = core.request(place, cut, 0)
    assert listening.result().data[-1:] == b"\3"


def test_late_replies_in_fragments_are_awaited_until_their_time_is_over(core) -> None:
    place = GatewayConversation(1001)
    named = MailboxRequest(MailboxType.SOE, bytes.fromhex("01401000"))
    core.request(place, named, 0)
    core.handle_timeout(TIMEOUT_NS)
    core.receive_frame(reply_of(MailboxType.SOE, bytes.fromhex("02401000 03")), TIMEOUT_NS)
    core.frames_to_send(0)
    again = core.request(place, named, TIMEOUT_NS)
    core.receive_frame(reply_of(MailboxType.SOE, bytes.fromhex("0a400100 01")), TIMEOUT_NS)
    assert (core.frames_to_send(0), again.is_done) == ([], False)
    core.receive_frame(reply_of(MailboxType.SOE, bytes.fromhex("02401000 02")), TIMEOUT_NS)
    assert len(core.frames_to_send(0)) == 1
