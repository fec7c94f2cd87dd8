"""Elements, vendors' messages, AMS packets and Ethernet settings in front of a slave."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from devicebus.errors import SoeError
from devicebus.mailbox import soe_client
from devicebus.mailbox.aoe_server import AoeServer
from devicebus.mailbox.eoe import iter_fragments as iter_ethernet
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.soe_server import SoeParameter, SoeServer
from eap.ads.request import Read, ReadWrite, Write, encode_query
from eap.ams.reassembly import FragmentAssembler, iter_fragments
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import AmsAnswer, AmsCommand, AmsHeader, StateFlags, decode_packet, encode_packet
from eap.codec.eoe import EoeType
from eap.codec.mailbox import MailboxType
from eap.codec.soe import Display, Element, Idn, SoeAttribute, encode_list
from eap.gateway.error_table import Cause
from eap.gateway.requests import GatewayError
from eap.ids import NetId
from eap.od.model import OdState
from eap.services.gateway import message_codecs
from eap.services.gateway.message_codecs import (
    AdsCodec,
    ElementCodec,
    EthernetCodec,
    VendorCodec,
)
from eap.services.gateway.sessions import SessionCodec
from eap.services.slaves.access import RemoteAccessError
from eap.services.slaves.remote_slave import LONGEST_ANSWER
from tests.support.elsewhere import Station
from tests.support.memoryslave import lead, memory_share, memory_slave
from tests.support.virtualtime import run_virtual

CLIENT, SLAVE = NetId.parse("7.7.7.7.1.1"), NetId.parse("5.1.1.1.9.1")
ROOM = 100
SIZES = MailboxSizes.of_data(ROOM)
TEXT = Idn.parse("P-0-0140")


def answer(codec: SessionCodec, body: str | bytes) -> list[str]:
    octets = bytes.fromhex(body) if isinstance(body, str) else body
    return [each.hex() for each in run_virtual(codec.answer(octets))]


def elements(station: Station) -> ElementCodec:
    return ElementCodec(station.link(), SIZES, memory_share())


def ads(station: Station) -> AdsCodec:
    return AdsCodec(station.link(), SIZES, memory_share())


# SoE


def test_element_codec_reads_and_writes_remote_elements() -> None:
    station = Station(b"\2\0\0\0")
    codec = elements(station)
    assert answer(codec, "01 40 2000") == ["02402000" + "02000000"]
    assert answer(codec, "0b 40 0100 0102") == []
    assert codec.is_running
    assert codec.completes_write(bytes.fromhex("03 40 2000 0304"))
    assert answer(codec, "03 40 2000 0304") == ["04402000"]
    assert not codec.is_running
    assert station.asked[-1] == Write(IndexGroup.SOE, 0x0040_0020, b"\1\2\3\4")
    station.result = AdsError.NOT_FOUND
    assert answer(codec, "01 40 2000") == ["12402000" + "0110"]
    assert answer(codec, "a3 40 2000 01") == ["b4402000" + "0110"]


def test_element_codec_carries_lists_in_fragments() -> None:
    sizes = MailboxSizes(32, 40)
    attribute = SoeAttribute(length=0, is_list=1, display=Display.TEXT)
    text = SoeParameter("P-0-0140", "T" * 60, attribute, max_length=200)
    server = SoeServer({0: [text]}, lambda: OdState.OP, sizes)
    slave, mailbox = memory_slave(MailboxType.SOE, server, sizes)
    codec, value = ElementCodec(slave, sizes, memory_share()), encode_list(bytes(range(100)))

    async def run() -> None:
        running: list[bool] = []
        await lead(codec, soe_client.write(TEXT, value, sizes), running)
        assert running == [True] * (len(running) - 1) + [False]
        assert len(running) >= 5
        running.clear()
        found = await lead(codec, soe_client.read(TEXT, Element.VALUE), running)
        assert found[4:] == value[4:]
        assert running == [False]
        with pytest.raises(SoeError) as refused:
            await lead(codec, soe_client.read(Idn.parse("S-0-0001")))
        assert refused.value.code == 0x1001

    run_virtual(run())
    assert all(len(each) <= sizes.to_slave - 6 for each in mailbox.asked)


def test_element_codec_forgets_fragments_that_were_given_up() -> None:
    station = Station()
    codec = elements(station)
    answer(codec, "0b 40 0100 0102")
    codec.reset()
    answer(codec, "03 40 2000 0304")
    assert station.asked[-1] == Write(IndexGroup.SOE, 0x0040_0020, b"\3\4")


def test_element_codec_refuses_a_list_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(message_codecs, "MAX_WRITTEN", 3)
    codec = elements(Station())
    answer(codec, "0b 40 0100 0102")
    with pytest.raises(GatewayError) as caught:
        answer(codec, "0b 40 0100 0102")
    assert caught.value.cause is Cause.TOO_LONG


def test_element_codec_refuses_fragments_without_memory() -> None:
    codec = ElementCodec(Station().link(), SIZES, memory_share(3))
    answer(codec, "0b 40 0100 0102")
    with pytest.raises(GatewayError) as caught:
        answer(codec, "0b 40 0100 0102")
    assert caught.value.cause is Cause.CROWDED


# VoE and EoE


def test_vendor_codec_passes_messages() -> None:
    station = Station(b"abc")
    codec = VendorCodec(station.link(), SIZES, memory_share())
    message = bytes.fromhex("5a0e0000 0100")
    assert answer(codec, message) == ["616263"]
    assert station.asked == [ReadWrite(IndexGroup.VOE, 0, LONGEST_ANSWER, message)]
    assert not codec.is_running
    assert not codec.is_step(message)


def test_ethernet_codec_collects_frames_for_remote_slaves() -> None:
    station = Station()
    codec = EthernetCodec(station.link(), SIZES, memory_share())
    frame = bytes(range(200))
    for fragment in iter_ethernet(frame, 3, 96):
        assert answer(codec, fragment) == []
    assert station.asked == [Write(IndexGroup.EOE, 0, frame)]


def test_ethernet_codec_passes_settings_of_remote_slaves() -> None:
    station = Station(bytes.fromhex("0700 0000"))
    codec = EthernetCodec(station.link(), SIZES, memory_share())
    assert answer(codec, "0600 0000") == ["07000000"]
    assert station.asked == [ReadWrite(IndexGroup.EOE, EoeType.GET_IP_REQUEST, 1024, b"")]


# AoE


def packet(operation: Read | Write, flags: StateFlags = StateFlags.ADS) -> bytes:
    command, body = encode_query(operation)
    header = AmsHeader(SLAVE, 1001, CLIENT, 800, command, flags, invoke_id=77)
    return encode_packet(header, body)


def joined(replies: Iterator[bytes] | list[bytes]) -> bytes:
    assembler, whole = FragmentAssembler(), None
    for each in replies:
        header, body = decode_packet(each)
        whole, _ = assembler.receive(header, bytes(body), 0)
    assert whole is not None
    return whole


def test_ads_codec_answers_from_the_address_that_the_client_named() -> None:
    station = Station(b"abcd")
    (reply,) = answer(ads(station), packet(Read(0x4020, 5, 4)))
    header, body = decode_packet(bytes.fromhex(reply))
    assert (header.source, header.source_port, header.invoke_id) == (SLAVE, 1001, 77)
    assert (header.target, header.target_port) == (CLIENT, 800)
    assert header.state_flags == StateFlags.RESPONSE | StateFlags.ADS
    assert bytes(body) == bytes(4) + b"\4\0\0\0abcd"
    assert station.asked == [Read(0x4020, 5, 4)]


def test_ads_codec_passes_errors() -> None:
    (reply,) = answer(ads(Station(result=0x712)), packet(Read(0x4020, 5, 4)))
    assert decode_packet(bytes.fromhex(reply))[1][:4] == b"\x12\7\0\0"


def test_ads_codec_takes_and_gives_fragments() -> None:
    station = Station()
    codec = ads(station)
    *first, last = iter_fragments(packet(Write(1, 2, bytes(300))), 3, 60)
    assert [answer(codec, each) for each in first] == [[]] * len(first)
    assert codec.is_running
    (done,) = answer(codec, last)
    assert not codec.is_running
    assert decode_packet(bytes.fromhex(done))[0].command == AmsCommand.WRITE
    assert station.asked == [Write(1, 2, bytes(300))]

    station.data = bytes(range(200))
    replies = [bytes.fromhex(each) for each in answer(codec, packet(Read(1, 2, 200)))]
    assert max(map(len, replies)) <= ROOM
    assert decode_packet(joined(replies))[1][8:] == bytes(range(200))


def test_ads_codec_acknowledges_a_fragment_that_wants_it() -> None:
    first, *_ = iter_fragments(packet(Write(1, 2, bytes(100))), 3, 60)
    header, body = decode_packet(first)
    wanted = AmsHeader(
        header.target, header.target_port, header.source, header.source_port,
        header.command, StateFlags.ADS, invoke_id=header.invoke_id,
    )  # fmt: skip
    codec = ads(Station())
    (reply,) = answer(codec, encode_packet(wanted, body))
    assert decode_packet(bytes.fromhex(reply))[0].state_flags & StateFlags.RESPONSE
    codec.reset()
    assert not codec.is_running


def test_ads_codec_refuses_fragments_without_memory() -> None:
    codec = AdsCodec(Station().link(), SIZES, memory_share(10))
    first, *_ = iter_fragments(packet(Write(1, 2, bytes(100))), 3, 60)
    with pytest.raises(GatewayError) as caught:
        answer(codec, first)
    assert caught.value.cause is Cause.CROWDED


def test_ads_codec_request_without_return_has_no_answer() -> None:
    station = Station()
    request = packet(Write(1, 2, b"x"), StateFlags.ADS | StateFlags.NO_RETURN)
    assert answer(ads(station), request) == []
    assert station.asked == [Write(1, 2, b"x")]


@pytest.mark.parametrize("command", [AmsCommand.FRAGMENT, AmsCommand.READ_STATE])
def test_ads_codec_does_not_answer_answers(command: AmsCommand) -> None:
    flags = StateFlags.ADS | StateFlags.RESPONSE
    header = AmsHeader(SLAVE, 1001, CLIENT, 800, command, flags, invoke_id=1)
    station = Station()
    assert answer(ads(station), encode_packet(header, b"")) == []
    assert not station.asked


@pytest.mark.parametrize("command", [AmsCommand.ADD_NOTIFICATION, 0x7777])
def test_ads_codec_has_no_remote_notifications(command: int) -> None:
    header = AmsHeader(SLAVE, 1001, CLIENT, 800, command, StateFlags.ADS, invoke_id=1)
    with pytest.raises(RemoteAccessError) as caught:
        answer(ads(Station()), encode_packet(header, b""))
    assert caught.value.result == AdsError.SERVICE


@pytest.mark.parametrize("room", [20, 60, 400])
def test_ads_codec_reaches_a_slave_of_this_bus(room: int) -> None:
    """A request and its answer, in fragments as far as the slave's mailbox needs them."""
    sizes = MailboxSizes.of_data(AmsHeader.SIZE + room)
    seen: list[bytes] = []

    def handle(header: AmsHeader, data: bytes) -> AmsAnswer:
        seen.append(data)
        return AmsAnswer(data[::-1])

    slave, _ = memory_slave(MailboxType.AOE, AoeServer(handle, sizes), sizes)
    codec = AdsCodec(slave, sizes, memory_share())
    request = packet(Write(1, 2, bytes(range(50))))
    parts = [request] if room >= len(request) else [*iter_fragments(request, 5, room)]
    replies = [bytes.fromhex(each) for part in parts for each in answer(codec, part)]
    whole = replies[0] if len(replies) == 1 else joined(replies)
    assert bytes(decode_packet(whole)[1]) == seen[0][::-1]
    silent = packet(Write(1, 2, bytes(range(50))), StateFlags.ADS | StateFlags.NO_RETURN)
    parts = [silent] if room >= len(silent) else [*iter_fragments(silent, 6, room)]
    assert [each for part in parts for each in answer(codec, part)] == []
    assert len(seen) == 2
