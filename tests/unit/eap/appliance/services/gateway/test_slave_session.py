"""One client, one slave, one protocol; what several do to each other is in test_gateway."""

from __future__ import annotations

import asyncio

import pytest

from devicebus.errors import (
    MailboxRefusedError,
    MailboxTimeoutError,
)
from devicebus.mailbox.conversation import Ask, Message
from eap.aoe.answer import AmsAnswer, response_to
from eap.aoe.fragment import iter_fragments
from eap.appliance.bus_request import SlaveReport
from eap.appliance.services.gateway.slave_session import SlaveSession, find_refusal
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, encode_packet
from eap.codec.mailbox import MailboxType
from eap.gateway.refusal import Reason
from eap.ids import NetId

COE, FOE = MailboxType.COE, MailboxType.FOE
SLAVE = SlaveReport(
    station=1001, name="s", vendor=1, product=2, revision=3, serial=4, alias=0, state=8, target=8,
    to_slave=64, to_master=64, protocols=0x0C,
)  # fmt: skip
UPLOAD = bytes.fromhex("0020 40 1810 01 00000000")
BEGIN = bytes.fromhex("02 00 00000000 66")
ACK = bytes.fromhex("04 00 00000000")


class Talk:
    """A slave that answers with what it is told."""

    def __init__(self, *answers: bytes | BaseException) -> None:
        self.answers = list(answers)
        self.asked: list[Ask] = []
        self.ended = ""

    async def ask(self, ask: Ask) -> Message:
        self.asked.append(ask)
        if not ask.expects_reply:
            return Message(ask.type, b"")
        answer = self.answers.pop(0)
        if isinstance(answer, BaseException):
            raise answer
        return Message(ask.type, answer, 0, 5)

    def close(self) -> None:
        self.ended = "closed"

    def abandon(self) -> None:
        self.ended = "abandoned"


def session(kind: MailboxType, talk: Talk, idle_s: float = 5.0) -> SlaveSession:
    async def open_talk() -> Talk:
        return talk

    return SlaveSession(kind, SLAVE, open_talk, answer_s=0.5, idle_s=idle_s)


def test_a_request_and_its_reply() -> None:
    async def run() -> None:
        talk = Talk(bytes.fromhex("0030 43 1810 01 02000000"))
        (reply,) = await session(COE, talk).ask(UPLOAD, is_step=False)
        assert (reply.type, reply.counter, reply.reason) == (COE, 5, None)
        assert talk.ended == "closed"
        assert 0 < talk.asked[0].timeout_ns <= 500_000_000

    asyncio.run(run())


def test_fragments_of_an_answer_are_waited_for() -> None:
    async def run() -> None:
        parts = [bytes.fromhex("0080 82 00 0100 0100 0010"), bytes.fromhex("0080 02 00 0000 0110")]
        talk = Talk(*parts)
        asked = bytes.fromhex("0080 01 00 0000 0100")
        replies = await session(COE, talk).ask(asked, is_step=False)
        assert [reply.body for reply in replies] == parts
        first, second = talk.asked
        assert (first.listen, first.request) == (False, asked)
        assert (second.listen, second.request) == (True, asked[:6])

    asyncio.run(run())


def test_a_packet_in_fragments_is_answered_as_a_whole_one() -> None:
    header = AmsHeader(
        NetId.parse("1.2.3.4.5.6"), 1001, NetId.parse("6.5.4.3.2.1"), 1, AmsCommand.READ,
        StateFlags.ADS, invoke_id=7,
    )  # fmt: skip
    request, answer = encode_packet(header, bytes(12)), response_to(header, AmsAnswer(bytes(20)))

    async def run() -> None:
        parts = list(iter_fragments(answer, 3, 20))
        talk = Talk(*parts)
        one = session(MailboxType.AOE, talk)
        first, last = iter_fragments(request, 5, 20)
        assert await one.ask(first, is_step=False) == []
        assert one.is_running
        replies = await one.ask(last, is_step=False)
        assert [reply.body for reply in replies] == parts
        assert not one.is_running
        whole = request[: AmsHeader.SIZE]
        assert [(each.listen, each.request) for each in talk.asked] == [
            (False, first),
            (False, last),
            (True, whole),
            (True, whole),
        ]

    asyncio.run(run())


def test_a_transfer_keeps_its_turn_until_nobody_goes_on_with_it() -> None:
    async def run() -> None:
        talk = Talk(ACK)
        one = session(FOE, talk, idle_s=0.02)
        await one.ask(BEGIN, is_step=False)
        assert one.is_running
        assert not talk.ended
        await asyncio.sleep(0.05)
        assert talk.ended == "abandoned"
        assert not one.is_running
        (reply,) = await one.ask(bytes.fromhex("03 00 01000000"), is_step=True)
        assert reply.reason is Reason.SERVICE

    asyncio.run(run())


def test_a_slaves_own_refusal_goes_through() -> None:
    async def run() -> None:
        talk = Talk(MailboxRefusedError("no", detail=4))
        (reply,) = await session(COE, talk).ask(UPLOAD, is_step=False)
        assert (reply.type, reply.body) == (MailboxType.ERR, bytes.fromhex("0100 0400"))
        assert talk.ended == "closed"

    asyncio.run(run())


def test_a_time_out_in_the_middle_ends_the_transfer() -> None:
    async def run() -> None:
        talk = Talk(ACK, MailboxTimeoutError("silent"))
        one = session(FOE, talk)
        await one.ask(BEGIN, is_step=False)
        (reply,) = await one.ask(bytes.fromhex("03 00 01000000") + bytes(52), is_step=True)
        assert reply.reason is Reason.TIMEOUT
        assert (talk.ended, one.is_running) == ("abandoned", False)

    asyncio.run(run())


def test_a_request_that_is_cancelled_leaves_nothing_behind() -> None:
    async def run() -> None:
        talk = Talk(asyncio.CancelledError())
        with pytest.raises(asyncio.CancelledError):
            await session(FOE, talk).ask(BEGIN, is_step=False)
        assert talk.ended == "abandoned"

    asyncio.run(run())


def test_what_does_not_even_go_to_the_slave() -> None:
    assert find_refusal(COE, bytes(58), SLAVE) is None
    assert find_refusal(COE, bytes(59), SLAVE) is Reason.TOO_LONG
    assert find_refusal(MailboxType.SOE, b"", SLAVE) is Reason.NO_PROTOCOL
