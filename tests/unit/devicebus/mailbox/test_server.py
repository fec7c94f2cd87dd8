"""The rules of all mailbox protocols, with a protocol that answers as told."""

from __future__ import annotations

import io
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox import coe_client, eoe, foe_client, voe
from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.foe_server import FoeServer, MemoryFile, MemoryStore
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.server import MAX_QUEUED, MailboxServer
from devicebus.mailbox.voe import VoeServer
from eap.codec.coe import Emergency
from eap.codec.mailbox import (
    MailboxError,
    MailboxErrorReply,
    MailboxHeader,
    MailboxType,
    decode_message,
    encode_message,
)
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RW, OdState, variable
from tests.support.examples import examples
from tests.support.mailbox import Fault, Line


class Echo:
    """Answers each byte of a request with a message of its own; keeps what it got."""

    def __init__(self) -> None:
        self.received: list[tuple[bytes, int]] = []
        self.unasked: list[bytes] = []
        self.resets = 0

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        self.received.append((data, now_ns))
        return [bytes((octet,)) for octet in data]

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        messages, self.unasked = self.unasked, []
        return messages

    def reset(self) -> None:
        self.resets += 1


class Box:
    """A slave with VoE, and the end of the master."""

    def __init__(self) -> None:
        self.echo = Echo()
        self.server = MailboxServer({MailboxType.VOE: self.echo}, MailboxSizes(32, 32))

    def send(
        self,
        data: bytes,
        *,
        counter: int = 0,
        kind: MailboxType = MailboxType.VOE,
        address: int = 0,
        now_ns: int = 0,
    ) -> None:
        header = MailboxHeader(0, address, type=kind, counter=counter)
        self.server.receive_message(encode_message(header, data).ljust(32, b"\0"), now_ns)

    def fetch(self) -> tuple[MailboxHeader, bytes]:
        message = self.server.next_message(0)
        assert message is not None
        self.server.handle_read()
        header, data = decode_message(message)
        return header, bytes(data)

    def refusal(self) -> str:
        header, data = self.fetch()
        assert header.type is MailboxType.ERR
        return MailboxError(MailboxErrorReply.decode(data).detail).name


def test_mailbox_server_reply_has_the_request_address_and_own_counter() -> None:
    box = Box()
    box.send(b"a", counter=5, address=0x1001, now_ns=9)
    box.send(b"bc", counter=6, address=0)
    assert box.echo.received == [(b"a", 9), (b"bc", 0)]
    headers = [box.fetch()[0] for _ in range(3)]
    assert [(head.address, head.counter) for head in headers] == [(0x1001, 1), (0, 2), (0, 3)]
    assert box.server.next_message(0) is None


def test_reply_counter_never_is_0() -> None:
    box = Box()
    for _ in range(9):
        box.send(b"a")
        assert box.fetch()[0].counter
    assert box.server.stats().sent == 9


def test_mailbox_server_drops_a_request_with_a_repeated_counter() -> None:
    box = Box()
    for counter in (1, 1, 2, 0, 0, 2):
        box.send(b"a", counter=counter)
    assert len(box.echo.received) == 5
    stats = box.server.stats()
    assert (stats.received, stats.repeated_requests, stats.gaps) == (6, 1, 0)


def test_gap_in_the_requests_is_counted() -> None:
    box = Box()
    box.send(b"a", counter=1)
    box.send(b"a", counter=3)
    assert box.server.stats().gaps == 1


@pytest.mark.parametrize(
    ("octets", "detail"),
    [
        ("0000 0000 00 0f", "INVALID_HEADER"),
        ("1b00 0000 00 0f", "INVALID_HEADER"),
        ("ffff 0000 00 0f", "INVALID_HEADER"),
        ("0400 0000 00 00 01000200", "INVALID_HEADER"),
        ("0100 0000 01 0f 61", "INVALID_CHANNEL"),
        ("0100 0000 00 03 61", "UNSUPPORTED_PROTOCOL"),
        ("0100 0000 00 06 61", "UNSUPPORTED_PROTOCOL"),
    ],
)
def test_mailbox_server_answers_unsupported_protocols_with_a_mailbox_error(
    octets: str, detail: str
) -> None:
    box = Box()
    box.server.receive_message(bytes.fromhex(octets).ljust(32, b"\0"), 0)
    assert box.refusal() == detail
    assert box.echo.received == []
    assert box.server.stats().refused == 1


def test_mailbox_server_error_reply_as_the_vector() -> None:
    box = Box()
    box.send(b"a", kind=MailboxType.FOE, address=0x03E9)
    assert box.server.next_message(0) == bytes.fromhex("0400 e903 00 10 0100 0200")


def test_longest_message_fills_the_mailbox() -> None:
    box = Box()
    box.send(bytes(26))
    assert box.echo.received == [(bytes(26), 0)]


def test_mailbox_server_too_long_answer_becomes_an_error() -> None:
    box = Box()
    box.echo.unasked = [bytes(26), bytes(27)]
    assert box.fetch()[1] == bytes(26)
    assert box.refusal() == "INVALID_SIZE"


def test_mailbox_server_with_a_full_queue_accepts_no_request() -> None:
    box = Box()
    assert box.server.is_ready
    box.send(bytes(MAX_QUEUED), counter=1)
    assert not box.server.is_ready
    box.send(b"a", counter=2)
    assert (len(box.echo.received), box.server.stats().dropped) == (1, 1)
    box.fetch()
    assert box.server.is_ready
    box.send(b"a", counter=2)
    assert len(box.echo.received) == 2


def test_message_without_a_header_is_dropped() -> None:
    box = Box()
    box.server.receive_message(bytes(5), 0)
    assert box.server.next_message(0) is None
    assert box.server.stats().dropped == 1


def test_mailbox_server_sends_answers_before_unsolicited_messages() -> None:
    box = Box()
    box.echo.unasked = [b"news"]
    box.send(b"a", address=7)
    assert [box.fetch()[1] for _ in range(2)] == [b"a", b"news"]


def test_mailbox_server_unsolicited_message_has_address_0() -> None:
    box = Box()
    box.send(b"a", address=7)
    box.fetch()
    box.echo.unasked = [b"news"]
    assert box.fetch()[0].address == 0


def test_mailbox_server_repeats_the_last_read_message() -> None:
    box = Box()
    box.send(b"abc")
    first = box.server.next_message(0)
    box.server.handle_read()
    second = box.server.next_message(0)
    assert box.server.repeat_message() == first
    box.server.handle_read()
    assert box.server.next_message(0) == second
    box.server.handle_read()
    assert box.server.repeat_message() == second
    box.server.handle_read()
    assert box.fetch()[1] == b"c"
    assert box.server.stats().repeated_replies == 2


def test_mailbox_server_repeat_before_the_first_read_has_no_effect() -> None:
    box = Box()
    assert box.server.repeat_message() is None
    box.send(b"a")
    assert box.server.next_message(0) is not None
    assert box.server.repeat_message() is None
    box.server.handle_read()
    box.server.handle_read()
    assert box.server.next_message(0) is None


def test_mailbox_server_start_keeps_the_counters_only() -> None:
    box = Box()
    box.send(b"ab", counter=1)
    box.fetch()
    box.server.start(64, 48)
    assert (box.server.sizes.to_slave, box.server.sizes.to_master) == (64, 48)
    assert box.echo.resets == 1
    assert box.server.next_message(0) is None
    assert box.server.repeat_message() is None
    box.send(b"c", counter=1)
    assert box.fetch()[0].counter == 1
    assert box.server.stats().received == 2


@given(st.lists(st.binary(max_size=40), max_size=12))
def test_mailbox_server_any_bytes_are_answered_or_counted(messages: list[bytes]) -> None:
    box = Box()
    for octets in messages:
        box.server.receive_message(octets, 0)
    stats = box.server.stats()
    assert stats.received + stats.dropped == len(messages)
    assert stats.repeated_requests + stats.refused + len(box.echo.received) == stats.received
    while (message := box.server.next_message(0)) is not None:
        decode_message(message)
        assert len(message) <= 32


class MailboxMachine(RuleBasedStateMachine):
    """Protocols side by side: each gets its own answers, and every emergency arrives once."""

    def __init__(self) -> None:
        super().__init__()
        self.sizes = MailboxSizes(32, 28)
        self.coe = CoeServer(
            ObjectDictionary([variable(0x2000, "Text", "STRING(90)", RW, "x" * 90)]),
            lambda: OdState.OP,
            self.sizes,
        )
        protocols = {
            MailboxType.COE: self.coe,
            MailboxType.FOE: FoeServer(MemoryStore([MemoryFile("f")]), self.sizes),
            MailboxType.VOE: VoeServer(),
        }
        dice = Random(11)
        bad = [Fault.NONE] * 6 + list(Fault)
        self.line = Line(MailboxServer(protocols, self.sizes), lambda: dice.choice(bad))
        self.file = b""
        self.codes: list[int] = []

    @rule(code=st.integers(1, 0xFFFF))
    def emergency(self, code: int) -> None:
        # Fetched at the latest when so many wait, so that none is dropped.
        if len(self.codes) % 10 == 9:
            self.line.fetch()
        self.coe.send_emergency(code)
        self.codes.append(code)

    @rule()
    def upload(self) -> None:
        assert self.line.run(coe_client.upload(0x2000, 0)) == b"x" * 90

    @rule(data=st.binary(max_size=50))
    def write(self, data: bytes) -> None:
        source = io.BytesIO(data)
        self.line.run(foe_client.write("f", source.read, self.sizes))
        self.file = data

    @rule()
    def read(self) -> None:
        sink = io.BytesIO()
        self.line.run(foe_client.read("f", sink.write, self.sizes))
        assert sink.getvalue() == self.file

    @rule(data=st.binary(max_size=16))
    def echo(self, data: bytes) -> None:
        assert self.line.run(voe.exchange(1, 2, data)) == data

    @rule()
    def refused(self) -> None:
        with pytest.raises(MailboxRefusedError) as caught:
            self.line.run(eoe.get_ip())
        assert caught.value.detail == MailboxError.UNSUPPORTED_PROTOCOL

    def teardown(self) -> None:
        found = [Emergency.decode(message.data, 2).error_code for message in self.line.fetch()]
        assert found == self.codes
        assert self.line.server.stats().gaps == 0


TestMailboxMachine = MailboxMachine.TestCase
TestMailboxMachine.settings = examples(25, stateful_step_count=30)
