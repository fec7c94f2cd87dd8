from __future__ import annotations

from contextlib import suppress
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import BusError, MailboxProtocolError, MailboxSizeError
from devicebus.mailbox import aoe_client
from devicebus.mailbox.aoe_server import AoeServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.ams import AmsAnswer, AmsCommand, AmsHeader, StateFlags, encode_packet
from eap.codec.mailbox import MailboxType
from eap.ids import NetId
from tests.support.examples import examples
from tests.support.mailbox import Fault, Line, open_line, run_with, talk_to

AOE = MailboxType.AOE
SIZES = MailboxSizes(128, 128)
HERE, SLAVE = NetId.parse("1.2.3.4.5.6"), NetId.parse("6.5.4.3.2.1")
READ = AmsHeader(SLAVE, 1001, HERE, 300, 2, invoke_id=7)


def reply(
    *, source: NetId = SLAVE, port: int = 1001, command: int = 2, flags: int = 5, invoke_id: int = 7
) -> bytes:
    header = AmsHeader(HERE, 300, source, port, command, flags, invoke_id=invoke_id)
    return encode_packet(header, b"answer")


def test_aoe_exchange_returns_the_answer_to_its_request() -> None:
    others = [
        reply(source=HERE),
        reply(port=1002),
        reply(command=3),
        reply(flags=StateFlags.ADS),
        reply(invoke_id=8),
    ]
    (header, data), asked = run_with(
        AOE, aoe_client.exchange(READ, b"ask", SIZES), [*others, reply()]
    )
    assert (header.invoke_id, data) == (7, b"answer")
    assert asked == [encode_packet(READ, b"ask")]


def serve(sizes: MailboxSizes, seed: int | None = None) -> Line:
    dice = Random(seed)
    bad = [Fault.NONE] * 6 + list(Fault)
    server = AoeServer(lambda header, data: AmsAnswer(data[::-1]), sizes)
    return open_line(AOE, server, sizes, lambda: dice.choice(bad) if seed else Fault.NONE)


@examples(40)
@given(st.binary(max_size=400), st.integers(39, 128), st.integers(39, 128), st.integers(0, 1 << 30))
def test_aoe_exchange_with_mailboxes_of_any_size(
    data: bytes, to_slave: int, to_master: int, seed: int
) -> None:
    line = serve(MailboxSizes(to_slave, to_master), seed)
    header, answer = line.run(aoe_client.exchange(READ, data, line.server.sizes))
    assert (header.source, header.error_code, answer) == (SLAVE, 0, data[::-1])
    assert max(map(len, line.sent)) <= to_slave - 6


def test_aoe_client_fragments_as_the_vector() -> None:
    sizes = MailboxSizes(47, 60)
    _, asked = run_with(AOE, aoe_client.exchange(READ, bytes(range(10)), sizes), [reply()])
    assert [packet[16:24].hex() for packet in asked] == [
        "0209060009000000",
        "0209060009000000",
        "0209060008000000",
    ]
    assert [packet[28:32].hex() for packet in asked] == ["00000700", "01000700", "02000700"]
    content = b"".join(packet[32:] for packet in asked)
    assert content == bytes.fromhex("0200 0400 0a000000 00000000 07000000 00010203040506070809")
    assert {packet[:16] for packet in asked} == {encode_packet(READ, b"")[:16]}


def test_mailbox_that_holds_no_fragment_is_too_small() -> None:
    with pytest.raises(MailboxSizeError, match="32 bytes: a mailbox of 37 bytes"):
        next(aoe_client.exchange(READ, b"", MailboxSizes(37, 64)))


def part(
    fragment: int, body: bytes, *, number: int = 1, flags: int = 6, source: NetId = SLAVE
) -> bytes:
    invoke_id = number << 16 | fragment
    head = AmsHeader(HERE, 300, source, 1001, AmsCommand.FRAGMENT, flags, invoke_id=invoke_id)
    return encode_packet(head, body)


ANSWER = reply()[16:]


def test_aoe_fragments_are_acknowledged_on_request() -> None:
    answers = [part(0, ANSWER[:18], flags=4), part(1, ANSWER[18:20], flags=4), part(2, ANSWER[20:])]
    (_, data), asked = run_with(AOE, aoe_client.exchange(READ, b"", SIZES), answers)
    assert data == b"answer"
    assert [packet[16:20].hex() for packet in asked[1:]] == ["02090500"] * 2
    assert [packet[28:32].hex() for packet in asked[1:]] == ["00000100", "01000100"]


def test_fragments_of_others_are_not_taken() -> None:
    answers = [
        part(1, b"late"),
        part(0, reply(invoke_id=6)[16:]),
        part(0, ANSWER[:4], source=HERE),
        part(0, reply(invoke_id=6)[16:20], number=2),
        part(1, reply(invoke_id=6)[20:], number=2),
        part(0, ANSWER[:18], number=3),
        part(1, ANSWER[18:], number=3),
    ]
    assert talk_to(AOE, aoe_client.exchange(READ, b"", SIZES), *answers)[1] == b"answer"


def test_aoe_answer_without_fragments_after_fragments_of_others() -> None:
    answers = [part(1, b"late"), reply()]
    assert talk_to(AOE, aoe_client.exchange(READ, b"", SIZES), *answers)[1] == b"answer"


@pytest.mark.parametrize(
    ("answers", "reason"),
    [
        ([part(0, ANSWER[:18]), part(2, ANSWER[18:])], "fragment 2 of packet 1 out of order"),
        ([part(0, ANSWER[:18]), part(1, ANSWER)], "too long"),
        ([part(0, ANSWER[:18])[:-1]], "but 17 bytes follow"),
        ([part(n, b"") for n in range(1, 40)], "16 fragments of other answers"),
    ],
)
def test_fragments_that_break_the_protocol(answers: list[bytes], reason: str) -> None:
    with pytest.raises(MailboxProtocolError, match=reason):
        talk_to(AOE, aoe_client.exchange(READ, b"", SIZES), *answers)


@given(st.lists(st.binary(max_size=24), max_size=20))
def test_aoe_any_fragments_end_in_an_answer_or_an_error(noise: list[bytes]) -> None:
    answers = [part(n, body) for n, body in enumerate(noise)]
    with suppress(BusError):
        talk_to(AOE, aoe_client.exchange(READ, b"", SIZES), *answers)


@pytest.mark.parametrize("answer", [reply()[:31], reply()[:-1]])
def test_answer_that_is_cut_breaks_the_protocol(answer: bytes) -> None:
    with pytest.raises(MailboxProtocolError, match=r"AoE answer of 6\.5\.4\.3\.2\.1:1001"):
        talk_to(AOE, aoe_client.exchange(READ, b"", SIZES), answer)
