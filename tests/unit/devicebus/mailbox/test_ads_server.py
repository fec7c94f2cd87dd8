"""Which ADS requests a slave takes for its own."""

from __future__ import annotations

import pytest

from devicebus.mailbox.ads_server import AdsServer
from eap.codec.ams import AmsCommand, AmsHeader
from eap.ids import NetId
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, OdState, variable

BUS = NetId.parse("5.1.2.3.2.1")
STATION = 1001
OK = bytes(4)


@pytest.fixture
def server():
    dictionary = ObjectDictionary(
        [
            variable(0x1000, "Type", "UDINT", RO, 7),
        ]
    )
    return AdsServer(dictionary, lambda: OdState.PREOP, "a drive with a long name")


def call(server, command, *numbers, data=b"", target=BUS, port=STATION):
    header = AmsHeader(target, port, NetId.parse("1.1.1.1.1.1"), 33000, command)
    octets = b"".join(number.to_bytes(4, "little") for number in numbers)
    return server(header, octets + data)


def test_services_are_those_of_its_dictionary(server):
    read = call(server, AmsCommand.READ, 0xF302, 0x1000_0000, 4)
    assert read[:2] == (OK + b"\4\0\0\0" + b"\7\0\0\0", 0)
    assert call(server, AmsCommand.ADD_NOTIFICATION)[:2] == (b"", 0x701)
    assert call(server, AmsCommand.WRITE, 1, 3, 6, data=bytes(5)).data == b"\5\7\0\0"


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
