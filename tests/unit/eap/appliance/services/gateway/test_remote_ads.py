"""AMS packets in mailboxes, for a slave elsewhere."""

from __future__ import annotations

import asyncio

import pytest

from devicebus.mailbox.protocol import MailboxSizes
from eap.aoe.ads_operation import Read, Write
from eap.aoe.ads_query import encode_query
from eap.aoe.fragment import Assembler, iter_fragments
from eap.appliance.services.gateway.remote_ads import RemoteAds
from eap.codec.ads import AdsError
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, decode_packet, encode_packet
from eap.gateway.elsewhere import ElsewhereError
from eap.ids import NetId
from tests.support.elsewhere import Station

CLIENT, SLAVE = NetId.parse("7.7.7.7.1.1"), NetId.parse("5.1.1.1.9.1")
ROOM = 100
SIZES = MailboxSizes.of_data(ROOM)


def packet(operation: Read | Write, flags: StateFlags = StateFlags.ADS) -> bytes:
    command, body = encode_query(operation)
    header = AmsHeader(SLAVE, 1001, CLIENT, 800, command, flags, invoke_id=77)
    return encode_packet(header, body)


def answer(speaker: RemoteAds, octets: bytes) -> list[bytes]:
    return asyncio.run(speaker.answer(octets))


def test_the_answer_comes_from_whom_the_client_named() -> None:
    station = Station(b"abcd")
    (reply,) = answer(RemoteAds(station.link(), SIZES), packet(Read(0x4020, 5, 4)))
    header, body = decode_packet(reply)
    assert (header.source, header.source_port, header.invoke_id) == (SLAVE, 1001, 77)
    assert (header.target, header.target_port) == (CLIENT, 800)
    assert header.state_flags == StateFlags.RESPONSE | StateFlags.ADS
    assert bytes(body) == bytes(4) + b"\4\0\0\0abcd"
    assert station.asked == [Read(0x4020, 5, 4)]


def test_an_error_goes_back_as_it_is() -> None:
    (reply,) = answer(
        RemoteAds(Station(result=0x712).link(), SIZES),
        packet(Read(0x4020, 5, 4)),
    )
    assert decode_packet(reply)[1][:4] == b"\x12\7\0\0"


def test_fragments_both_ways() -> None:
    station = Station()
    speaker = RemoteAds(station.link(), SIZES)
    *first, last = iter_fragments(packet(Write(1, 2, bytes(300))), 3, 60)
    assert [answer(speaker, each) for each in first] == [[]] * len(first)
    (done,) = answer(speaker, last)
    assert decode_packet(done)[0].command == AmsCommand.WRITE
    assert station.asked == [Write(1, 2, bytes(300))]

    station.data = bytes(range(200))
    replies = answer(speaker, packet(Read(1, 2, 200)))
    assert max(map(len, replies)) <= ROOM
    assembler, whole = Assembler(), None
    for each in replies:
        header, body = decode_packet(each)
        whole, _ = assembler.receive(header, bytes(body), 0)
    assert whole is not None
    assert decode_packet(whole)[1][8:] == bytes(range(200))


def test_a_fragment_is_acknowledged_if_that_is_wanted() -> None:
    first, *_ = iter_fragments(packet(Write(1, 2, bytes(100))), 3, 60)
    header, body = decode_packet(first)
    wanted = AmsHeader(
        header.target, header.target_port, header.source, header.source_port,
        header.command, StateFlags.ADS, invoke_id=header.invoke_id,
    )  # fmt: skip
    speaker = RemoteAds(Station().link(), SIZES)
    (reply,) = answer(speaker, encode_packet(wanted, body))
    assert decode_packet(reply)[0].state_flags & StateFlags.RESPONSE
    speaker.reset()


def test_who_wants_no_answer_gets_none() -> None:
    station = Station()
    speaker = RemoteAds(station.link(), SIZES)
    assert answer(speaker, packet(Write(1, 2, b"x"), StateFlags.ADS | StateFlags.NO_RETURN)) == []
    assert station.asked == [Write(1, 2, b"x")]


@pytest.mark.parametrize("command", [AmsCommand.FRAGMENT, AmsCommand.READ_STATE])
def test_answers_are_not_answered(command: AmsCommand) -> None:
    flags = StateFlags.ADS | StateFlags.RESPONSE
    header = AmsHeader(SLAVE, 1001, CLIENT, 800, command, flags, invoke_id=1)
    station = Station()
    assert answer(RemoteAds(station.link(), SIZES), encode_packet(header, b"")) == []
    assert not station.asked


@pytest.mark.parametrize("command", [AmsCommand.ADD_NOTIFICATION, 0x7777])
def test_what_is_not_passed(command: int) -> None:
    header = AmsHeader(SLAVE, 1001, CLIENT, 800, command, StateFlags.ADS, invoke_id=1)
    with pytest.raises(ElsewhereError) as caught:
        answer(RemoteAds(Station().link(), SIZES), encode_packet(header, b""))
    assert caught.value.result == AdsError.SERVICE
