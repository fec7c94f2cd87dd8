from __future__ import annotations

import msgspec
import pytest

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.aoe_server import AdsServer, AoeServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.ams.reassembly import FragmentAssembler, iter_fragments
from eap.codec.ams import AmsAnswer, AmsCommand, AmsHeader, StateFlags, decode_packet, encode_packet
from eap.codec.mailbox import MailboxError, decode_frame
from eap.ids import NetId
from eap.od import info
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, RW, Entry, OdState, array, record, variable
from tests.support.vectors import load_all

BUS = NetId.parse("5.1.2.3.2.1")
STATION = 1001
OK = bytes(4)


@pytest.fixture
def dictionary():
    return ObjectDictionary(
        [
            variable(0x1000, "Type", "UDINT", RO, 7),
            array(0x2000, "Values", "UINT", [1, 2], RW),
            record(0x2001, "Gap", {1: Entry("a", "USINT"), 3: Entry("b", "USINT")}),
        ]
    )


@pytest.fixture
def server(dictionary):
    return AdsServer(dictionary, lambda: OdState.PREOP, "a drive with a long name")


def call(server, command, *numbers, data=b"", target=BUS, port=STATION):
    header = AmsHeader(target, port, NetId.parse("1.1.1.1.1.1"), 33000, command)
    octets = b"".join(number.to_bytes(4, "little") for number in numbers)
    return server(header, octets + data)


def test_address_is_that_of_the_first_request(server):
    call(server, AmsCommand.READ_STATE)
    assert server.address == (BUS, STATION)
    other = NetId.parse("5.1.2.3.9.1")
    assert call(server, AmsCommand.READ_STATE, target=other)[:2] == (b"", 7)
    assert call(server, AmsCommand.READ_STATE, port=1002)[:2] == (b"", 6)
    server.reset_address()
    assert call(server, AmsCommand.READ_STATE, target=other).error_code == 0


def test_ads_server_address_is_written_by_the_master(server):
    call(server, AmsCommand.READ_STATE)
    given = b"\0\0\0\0\4\1"
    assert call(server, AmsCommand.WRITE, 1, 3, 6, data=given, port=1005)[:2] == (OK, 0)
    assert server.address == (NetId.parse("5.1.2.3.4.1"), 1005)
    whole = bytes(NetId.parse("9.9.9.9.1.1"))
    assert call(server, AmsCommand.WRITE, 1, 3, 6, data=whole)[:2] == (OK, 0)
    assert call(server, AmsCommand.READ_STATE).error_code == 7
    assert call(server, AmsCommand.READ_STATE, target=NetId(whole)).error_code == 0


def u32(number):
    return number.to_bytes(4, "little")


def test_entries_are_read_and_written(server):
    read = call(server, AmsCommand.READ, 0xF302, 0x1000_0000, 4)
    assert read[:2] == (OK + u32(4) + u32(7), 0)
    assert call(server, AmsCommand.WRITE, 0xF302, 0x2000_0002, 2, data=b"\x34\x12")[:2] == (OK, 0)
    assert call(server, AmsCommand.READ, 0xF302, 0x2000_0002, 80).data == OK + u32(2) + b"\x34\x12"


def test_read_and_write_in_one(server):
    got = call(server, AmsCommand.READ_WRITE, 0xF302, 0x2000_0001, 2, 2, data=b"\5\6")
    assert got.data == OK + u32(2) + b"\5\6"
    got = call(server, AmsCommand.READ_WRITE, 0xF302, 0x2000_0001, 2, 0)
    assert got.data == OK + u32(2) + b"\5\6"


def test_aoe_server_reads_and_writes_whole_objects(server):
    whole = call(server, AmsCommand.READ, 0xF302, 0x2000_0100, 6).data
    assert whole == OK + u32(6) + bytes.fromhex("0200 0100 0200")
    data = bytes.fromhex("0200 0300 0400")
    assert call(server, AmsCommand.WRITE, 0xF302, 0x2000_0100, 6, data=data).data == OK
    assert call(server, AmsCommand.READ, 0xF302, 0x2000_0100, 6).data[8:] == data


def test_aoe_server_describes_objects(server, dictionary):
    for offset, group, expected in (
        (0, 0xF3FC, info.object_list(dictionary, 0)),
        (0x0001_0000, 0xF3FC, info.object_list(dictionary, 1)),
        (0x2000_0000, 0xF3FD, info.object_description(dictionary, 0x2000)),
        (0x2000_0702, 0xF3FE, info.entry_description(dictionary, 0x2000, 2, 7)),
    ):
        got = call(server, AmsCommand.READ, group, offset, 100).data
        assert got == OK + u32(len(expected)) + expected


def test_device_and_state(server):
    assert call(server, AmsCommand.READ_DEVICE_INFO).data == OK + b"\1\0\0\0a drive with a \0"
    assert call(server, AmsCommand.READ_STATE).data == OK + bytes.fromhex("05000000")


@pytest.mark.parametrize(
    ("command", "numbers", "data", "result"),
    [
        (AmsCommand.READ, (0xF302, 0x3000_0000, 4), b"", 0x70C),
        (AmsCommand.READ, (0xF302, 0x1000_0001, 4), b"", 0x70C),
        (AmsCommand.READ, (0xF302, 0x2001_0002, 4), b"", 0x700),
        (AmsCommand.READ, (0xF302, 0x1000_0200, 4), b"", 0x703),
        (AmsCommand.READ, (0xF302, 0x1000_0000, 3), b"", 0x705),
        (AmsCommand.READ, (0xF302, 0x1000_0000), b"", 0x705),
        (AmsCommand.READ, (0xF3FC, 0x0009_0000, 80), b"", 0x700),
        (AmsCommand.READ, (0xF3FD, 0x3000_0000, 80), b"", 0x70C),
        (AmsCommand.READ, (0x4020, 0, 4), b"", 0x702),
        (AmsCommand.WRITE, (0xF302, 0x1000_0000, 4), bytes(4), 0x700),
        (AmsCommand.WRITE, (0xF302, 0x2000_0001, 4), bytes(2), 0x705),
        (AmsCommand.WRITE, (0xF3FC, 0, 1), b"\0", 0x702),
        (AmsCommand.WRITE, (1, 3, 6), bytes(5), 0x705),
        (AmsCommand.READ_WRITE, (0xF302, 0x1000_0000, 4, 1), b"", 0x705),
    ],
)
def test_aoe_server_refusals(server, command, numbers, data, result):
    length = b"" if command is AmsCommand.WRITE else bytes(4)
    assert call(server, command, *numbers, data=data)[:2] == (u32(result) + length, 0)


def test_sums_are_done_item_by_item(server):
    items = b"".join(map(u32, (0xF302, 0x1000_0000, 4, 0xF302, 0x3000_0000, 1)))
    got = call(server, AmsCommand.READ_WRITE, 0xF080, 2, 13, len(items), data=items)
    assert got.data == OK + u32(13) + OK + u32(0x70C) + u32(7) + b"\0"


def test_ads_server_refuses_unknown_services(server):
    assert call(server, AmsCommand.ADD_NOTIFICATION)[:2] == (b"", 0x701)


CAPTURED = {v.name.rpartition("/")[2]: v for v in load_all("ethernet")}
REQUEST, ANSWER = (
    bytes(decode_frame(CAPTURED[f"aoe_sdo_read_{name}"].frame)[1]) for name in ("req", "resp")
)


def answer(header: AmsHeader, data: bytes) -> AmsAnswer:
    assert header.command == 2
    assert data == bytes.fromhex("02f300000100181004000000")
    return AmsAnswer(bytes.fromhex("00000000 04000000 02000000"))


def test_aoe_server_answers_a_request_as_the_vector() -> None:
    server = AoeServer(answer, MailboxSizes())
    assert server.receive_message(REQUEST, 0) == [ANSWER]
    server.reset()
    assert server.messages_to_send(0) == []


def test_aoe_server_request_without_return_has_no_answer() -> None:
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
def test_aoe_server_answers_other_messages_with_a_mailbox_error(
    packet: bytes, detail: MailboxError
) -> None:
    with pytest.raises(MailboxRefusedError) as caught:
        AoeServer(answer, MailboxSizes()).receive_message(packet, 0)
    assert caught.value.detail == detail


def test_aoe_server_handler_may_return_no_answer() -> None:
    server = AoeServer(lambda header, data: AmsAnswer(error_code=7), MailboxSizes())
    header, body = decode_packet(server.receive_message(REQUEST, 0)[0])
    assert (header.error_code, bytes(body)) == (7, b"")


def test_aoe_server_long_answer_is_fragmented() -> None:
    long = bytes(n % 251 for n in range(300))
    server = AoeServer(lambda header, data: AmsAnswer(long), MailboxSizes(128, 128))
    assembler = FragmentAssembler()
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
    server = AoeServer(answer, MailboxSizes(), reset_handler=lambda: forgotten.append(1))
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
