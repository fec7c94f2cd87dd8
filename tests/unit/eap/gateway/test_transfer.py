"""Transfers are followed by their octets, as our own clients and servers send them."""

from __future__ import annotations

import io
import itertools
from collections.abc import Generator
from typing import Any

import pytest

from devicebus.errors import FoeError
from devicebus.mailbox import coe_client, coeinfo_client, foe_client, soe_client
from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.conversation import Ask, Conversation, Message
from devicebus.mailbox.foe_server import FoeServer
from devicebus.mailbox.foe_store import MemoryFile, MemoryStore
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.soe_parameter import SoeParameter
from devicebus.mailbox.soe_server import SoeServer
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, encode_packet
from eap.codec.mailbox import MailboxType
from eap.codec.soe import Display, Element, Idn, SoeAttribute, encode_list
from eap.gateway.transfer import Transfer, is_busy
from eap.ids import NetId
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RW, OdState, variable
from tests.support.mailbox import open_line

SIZES = MailboxSizes(32, 40)
FILE = bytes(range(100))
TEXT = Idn.parse("P-0-0140")


def coe() -> CoeServer:
    objects = [variable(0x2000, "Text", "STRING(300)", RW, ""), variable(0x2001, "N", "UDINT", RW)]
    return CoeServer(ObjectDictionary(objects), lambda: OdState.OP, SIZES)


def foe() -> FoeServer:
    store = MemoryStore([MemoryFile("f", FILE, max_size=1000)])
    return FoeServer(store, SIZES)


def soe() -> SoeServer:
    text = SoeAttribute(length=0, is_list=1, display=Display.TEXT)
    return SoeServer({0: [SoeParameter("P-0-0140", "T" * 60, text, max_length=200)]}, op, SIZES)


def op() -> OdState:
    return OdState.OP


def followed(
    talk: Conversation[Any], transfer: Transfer, running: list[bool]
) -> Generator[Ask, Message, Any]:
    """Lead a conversation, and note after each message whether its transfer is said to run."""
    ask = next(talk)
    while True:
        if not ask.listen:
            assert not transfer.is_repeated(ask.request)
            assert transfer.ask(ask.request) is ask.expects_reply
        message = yield ask
        if ask.expects_reply:
            transfer.answer(message.data)
        running.append(transfer.is_running)
        try:
            ask = talk.send(message)
        except StopIteration as end:
            return end.value


CASES = [
    (MailboxType.COE, coe, lambda: coe_client.download(0x2000, 0, b"x" * 100, SIZES), 5),
    (MailboxType.COE, coe, lambda: coe_client.upload(0x2001, 0), 1),
    (MailboxType.COE, coe, lambda: coe_client.download(0x2001, 0, b"1234", SIZES), 1),
    (MailboxType.COE, coe, lambda: coe_client.download(0x2000, 0, b"sixteen octets!!", SIZES), 1),
    (MailboxType.FOE, foe, lambda: foe_client.read("f", io.BytesIO().write, SIZES), 5),
    (MailboxType.FOE, foe, lambda: foe_client.write("f", io.BytesIO(FILE).read, SIZES), 7),
    (MailboxType.FOE, foe, lambda: foe_client.write("f", io.BytesIO(FILE[:40]).read, SIZES), 4),
    (MailboxType.SOE, soe, lambda: soe_client.write(TEXT, encode_list(FILE), SIZES), 5),
]


@pytest.mark.parametrize(("kind", "server", "talk", "least"), CASES)
def test_a_transfer_runs_until_its_last_message(kind, server, talk, least) -> None:
    running: list[bool] = []
    line = open_line(kind, server(), SIZES)
    line.run(followed(talk(), Transfer(kind, SIZES), running))
    assert running == [True] * (len(running) - 1) + [False]
    assert len(running) >= least


def test_upload_in_segments() -> None:
    line = open_line(MailboxType.COE, coe(), SIZES)
    line.run(coe_client.download(0x2000, 0, b"y" * 200, SIZES))
    running: list[bool] = []
    transfer = Transfer(MailboxType.COE, SIZES)
    assert line.run(followed(coe_client.upload(0x2000, 0), transfer, running)) == b"y" * 200
    assert running == [True] * (len(running) - 1) + [False]
    assert len(running) > 5


def test_what_is_answered_in_fragments_is_no_transfer() -> None:
    for kind, server, talk in (
        (MailboxType.COE, coe, coeinfo_client.object_list()),
        (MailboxType.SOE, soe, soe_client.read(TEXT, Element.NAME | Element.VALUE)),
    ):
        running: list[bool] = []
        line = open_line(kind, server(), SIZES)
        line.run(followed(talk, Transfer(kind, SIZES), running))
        assert running
        assert not any(running)


def test_what_a_slave_refuses_has_ended() -> None:
    running: list[bool] = []
    line = open_line(MailboxType.FOE, foe(), SIZES)
    talk = foe_client.read("none", io.BytesIO().write, SIZES)
    with pytest.raises(FoeError):
        line.run(followed(talk, Transfer(MailboxType.FOE, SIZES), running))
    assert running == [False]

    transfer = Transfer(MailboxType.COE, SIZES)
    transfer.ask(bytes.fromhex("0020 40 0020 00 00000000"))
    transfer.answer(bytes.fromhex("0030 41 0020 00 64000000") + bytes(20))
    assert transfer.is_running
    transfer.ask(bytes.fromhex("0020 60 00000000000000"))
    transfer.answer(bytes.fromhex("0020 80 0020 00 00000305"))
    assert not transfer.is_running


def test_a_client_may_give_up() -> None:
    transfer = Transfer(MailboxType.COE, SIZES)
    transfer.ask(bytes.fromhex("0020 40 0020 00 00000000"))
    transfer.answer(bytes.fromhex("0030 41 0020 00 64000000") + bytes(20))
    assert not transfer.ask(bytes.fromhex("0020 80 0020 00 00000000"))
    assert not transfer.is_running

    transfer = Transfer(MailboxType.FOE, SIZES)
    transfer.ask(bytes.fromhex("02 00 00000000 66"))
    transfer.answer(bytes.fromhex("04 00 00000000"))
    assert transfer.is_running
    assert not transfer.ask(bytes.fromhex("05 00 00800000"))
    assert not transfer.is_running


SEGMENT = bytes.fromhex("0020 60 00000000000000")
ACK = bytes.fromhex("04 00 01000000")


@pytest.mark.parametrize(
    ("kind", "begin", "begun", "step", "reply"),
    [
        (
            MailboxType.COE,
            "0020 40 0020 00 00000000",
            "0030 41 0020 00 64000000" + "00" * 20,
            SEGMENT,
            "0030 00 01020304050607",
        ),
        (MailboxType.FOE, "01 00 00000000 66", "03 00 01000000" + "00" * 28, ACK, "03 00 02000000"),
    ],
)
def test_a_step_that_comes_twice_is_known(kind, begin, begun, step, reply) -> None:
    transfer = Transfer(kind, SIZES)
    transfer.ask(bytes.fromhex(begin))
    transfer.answer(bytes.fromhex(begun))
    assert not transfer.is_repeated(bytes.fromhex(begin)), "it begins anew"
    assert not transfer.is_repeated(step)
    transfer.ask(step)
    assert not transfer.is_repeated(step), "there is no reply yet that could be sent again"
    transfer.answer(bytes.fromhex(reply))
    assert transfer.is_repeated(step)


def test_the_last_packet_is_not_confirmed_twice() -> None:
    transfer = Transfer(MailboxType.FOE, SIZES)
    transfer.ask(bytes.fromhex("01 00 00000000 66"))
    transfer.answer(bytes.fromhex("03 00 01000000") + b"the end")
    assert not transfer.is_repeated(ACK)
    assert not transfer.ask(ACK)
    assert not transfer.is_running
    assert transfer.is_repeated(ACK), "nothing answers it, the second time neither"
    assert not transfer.is_repeated(bytes.fromhex("04 00 02000000"))


def test_after_busy_the_same_packet_is_a_question() -> None:
    transfer = Transfer(MailboxType.FOE, SIZES)
    transfer.ask(bytes.fromhex("02 00 00000000 66"))
    transfer.answer(bytes.fromhex("04 00 00000000"))
    packet = bytes.fromhex("03 00 01000000") + bytes(20)
    busy = bytes.fromhex("06 00 00006400")
    assert is_busy(busy)
    transfer.ask(packet)
    transfer.answer(busy)
    assert transfer.is_running
    assert not transfer.is_repeated(packet)


def test_sizes_may_become_others_between_two_files() -> None:
    sizes = MailboxSizes(16, 16)
    transfer = Transfer(MailboxType.FOE, sizes)
    transfer.ask(bytes.fromhex("01 00 00000000 66"))
    sizes.set(16, 18)
    transfer.answer(bytes.fromhex("03 00 01000000 61626364"))
    assert not transfer.ask(bytes.fromhex("04 00 01000000")), "that was the last packet"


def ams(command: int, flags: int, body: bytes = b"") -> bytes:
    header = AmsHeader(
        NetId.parse("1.2.3.4.5.6"), 1001, NetId.parse("6.5.4.3.2.1"), 1, command, flags
    )
    return encode_packet(header, body)


def test_ams_packets() -> None:
    transfer = Transfer(MailboxType.AOE, SIZES)
    assert transfer.ask(ams(AmsCommand.READ, StateFlags.ADS))
    transfer.answer(ams(AmsCommand.READ, StateFlags.ADS | StateFlags.RESPONSE))
    assert not transfer.is_running
    assert not transfer.ask(ams(AmsCommand.READ, StateFlags.ADS | StateFlags.NO_RETURN))
    assert transfer.ask(ams(AmsCommand.FRAGMENT, StateFlags.ADS))
    transfer.answer(ams(AmsCommand.FRAGMENT, StateFlags.ADS | StateFlags.RESPONSE))
    assert transfer.is_running
    assert transfer.ask(ams(AmsCommand.FRAGMENT, StateFlags.ADS))
    transfer.answer(ams(AmsCommand.WRITE, StateFlags.ADS | StateFlags.RESPONSE))
    assert not transfer.is_running


@pytest.mark.parametrize(("octets", "expected"), [("0600", True), ("0000", False), ("", True)])
def test_ethernet_frames_have_no_answer(octets, expected) -> None:
    assert Transfer(MailboxType.EOE, SIZES).ask(bytes.fromhex(octets)) is expected


def test_voe_is_a_request_and_a_reply() -> None:
    transfer = Transfer(MailboxType.VOE, SIZES)
    assert transfer.ask(b"anything")
    transfer.answer(b"anything")
    assert not transfer.is_running
    assert not transfer.is_repeated(b"anything")


def test_what_is_cut_short_breaks_nothing() -> None:
    for kind, size in itertools.product(MailboxType, range(12)):
        transfer = Transfer(kind, SIZES)
        for octet in (0x00, 0x20, 0x41, 0xFF):
            transfer.ask(bytes((octet,)) * size)
            transfer.answer(bytes((octet,)) * size)
