"""Which ADS requests a slave takes for its own, and its object dictionary by ADS."""

from __future__ import annotations

import pytest

from devicebus.mailbox.ads_server import AdsServer
from eap.codec.ams import AmsCommand, AmsHeader
from eap.ids import NetId
from eap.od import info
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, RW, Entry, OdState, array, record, variable

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
    server.forget()
    assert call(server, AmsCommand.READ_STATE, target=other).error_code == 0


def test_address_is_what_the_master_writes(server):
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


def test_complete_access(server):
    whole = call(server, AmsCommand.READ, 0xF302, 0x2000_0100, 6).data
    assert whole == OK + u32(6) + bytes.fromhex("0200 0100 0200")
    data = bytes.fromhex("0200 0300 0400")
    assert call(server, AmsCommand.WRITE, 0xF302, 0x2000_0100, 6, data=data).data == OK
    assert call(server, AmsCommand.READ, 0xF302, 0x2000_0100, 6).data[8:] == data


def test_descriptions(server, dictionary):
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
def test_refusals(server, command, numbers, data, result):
    length = b"" if command is AmsCommand.WRITE else bytes(4)
    assert call(server, command, *numbers, data=data)[:2] == (u32(result) + length, 0)


def test_sums_are_done_item_by_item(server):
    items = b"".join(map(u32, (0xF302, 0x1000_0000, 4, 0xF302, 0x3000_0000, 1)))
    got = call(server, AmsCommand.READ_WRITE, 0xF080, 2, 13, len(items), data=items)
    assert got.data == OK + u32(13) + OK + u32(0x70C) + u32(7) + b"\0"


def test_service_that_is_not_there(server):
    assert call(server, AmsCommand.ADD_NOTIFICATION)[:2] == (b"", 0x701)
