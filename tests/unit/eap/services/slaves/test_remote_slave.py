"""Operations on a slave of another station, as requests by AoE."""

from __future__ import annotations

import pytest

from eap.ads.request import Read, Write
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import AmsAnswer, AmsCommand, AmsHeader, decode_packet
from eap.codec.coe import SdoInfoOpcode
from eap.errors import CodecError
from eap.ids import NetId
from eap.od.abort import AbortCode, SdoAbortError
from eap.services.slaves.access import RemoteAccessError
from eap.services.slaves.remote_slave import LONGEST_ANSWER, RemoteSlave
from tests.support import busads
from tests.support.elsewhere import Station
from tests.support.virtualtime import run_virtual


def mailboxes(bus: str, station: int) -> tuple[int, int]:
    async def scene(client: busads.Client, engine: object) -> tuple[int, int]:
        async def ask(port: int, command: int, body: bytes, *, timeout_s: float) -> AmsAnswer:
            return await client.answer(port, command, body)

        found = await RemoteSlave(ask, station, 1).sizes()
        return found.to_slave, found.to_master

    return busads.play(scene, bus)


def test_sizes_come_from_the_master() -> None:
    assert mailboxes("files", 1001) == (256, 256)
    assert mailboxes("files", 1002) == (128, 128)
    with pytest.raises(RemoteAccessError) as caught:
        mailboxes("aoe", 1002)
    assert caught.value.result == AdsError.NOT_READY
    with pytest.raises(RemoteAccessError) as caught:
        mailboxes("files", 1003)
    assert caught.value.result == AdsError.TARGET_PORT
    with pytest.raises(RemoteAccessError) as caught:
        mailboxes("files", 0xFFFF)
    assert caught.value.result == AdsError.SERVICE


def test_a_slave_behind_the_first_list() -> None:
    lists = {0xF020: range(1, 256), 0xF021: (900, 1001)}

    async def ask(port: int, command: int, body: bytes, *, timeout_s: float) -> AmsAnswer:
        offset = int.from_bytes(body[4:8], "little")
        index, subindex = offset >> 16, offset & 0xFF
        found = lists.get(index)
        data = (index + subindex).to_bytes(2, "little")
        if found is not None:
            words = (each.to_bytes(2, "little") for each in (len(found), *found))
            data = b"".join(words)
        return AmsAnswer(bytes(4) + len(data).to_bytes(4, "little") + data)

    number = 256
    expected = 0x8000 + number + 33, 0x8000 + number + 34
    found = run_virtual(RemoteSlave(ask, 1001, 1).sizes())
    assert (found.to_slave, found.to_master) == expected


@pytest.mark.parametrize(
    ("result", "told"),
    [
        (AdsError.NOT_FOUND, AdsError.SERVICE),
        (AdsError.HOST_UNREACHABLE, AdsError.HOST_UNREACHABLE),
    ],
)
def test_remote_master_without_a_dictionary(result: AdsError, told: AdsError) -> None:
    with pytest.raises(RemoteAccessError) as caught:
        run_virtual(Station(result=result).link().sizes())
    assert caught.value.result == told


def test_remote_slave_forwards_ams_requests() -> None:
    station = Station(b"xy")
    body = Read(IndexGroup.SDO, 1, 2)
    octets = b"".join(each.to_bytes(4, "little") for each in body)
    header = AmsHeader(NetId(bytes(6)), 1, NetId(bytes(6)), 2, AmsCommand.READ, invoke_id=7)
    answer = run_virtual(station.link().exchange_ads(header, octets))
    back, data = decode_packet(answer)
    assert (back.invoke_id, bytes(data[8:])) == (7, b"xy")
    assert station.asked == [body]


@pytest.mark.parametrize(
    ("opcode", "request_", "group", "offset"),
    [
        (SdoInfoOpcode.LIST_REQUEST, "0100", IndexGroup.OBJECT_LIST, 0x0001_0000),
        (SdoInfoOpcode.OBJECT_REQUEST, "1810", IndexGroup.OBJECT_DESCRIPTION, 0x1018_0000),
        (SdoInfoOpcode.ENTRY_REQUEST, "1810 02 7f", IndexGroup.ENTRY_DESCRIPTION, 0x1018_7F02),
    ],
)
def test_remote_slave_reads_sdo_information(
    opcode: SdoInfoOpcode, request_: str, group: IndexGroup, offset: int
) -> None:
    station = Station(b"described")
    found = run_virtual(station.link().read_info(opcode, bytes.fromhex(request_)))
    assert found == b"described"
    assert station.asked == [Read(group, offset, LONGEST_ANSWER)]


def test_remote_slave_refuses_unknown_sdo_information() -> None:
    slave = Station().link()
    with pytest.raises(RemoteAccessError):
        run_virtual(slave.read_info(SdoInfoOpcode.LIST_RESPONSE, b""))
    with pytest.raises(CodecError):
        run_virtual(slave.read_info(SdoInfoOpcode.LIST_REQUEST, b"\1"))


def test_remote_slave_reads_and_writes_whole_objects() -> None:
    station = Station(b"\2\0abcd")
    slave = station.link()
    assert run_virtual(slave.read_object(0x1018, 0, complete=True)) == b"\2\0abcd"
    assert run_virtual(slave.read_object(0x1018, 1, complete=True)) == b"abcd"
    assert station.asked == [Read(IndexGroup.SDO, 0x1018_0100, LONGEST_ANSWER)] * 2
    run_virtual(slave.write_object(0x2000, 0, b"ab", complete=True))
    assert station.asked[-1] == Write(IndexGroup.SDO, 0x2000_0100, b"ab")
    with pytest.raises(SdoAbortError) as caught:
        run_virtual(slave.write_object(0x2000, 1, b"ab", complete=True))
    assert caught.value.code == AbortCode.NO_COMPLETE_ACCESS


@pytest.mark.parametrize(
    ("result", "error", "code"),
    [
        (AdsError.NOT_FOUND, SdoAbortError, AbortCode.NO_OBJECT),
        (0x7FF, SdoAbortError, AbortCode.GENERAL),
        (AdsError.HOST_UNREACHABLE, RemoteAccessError, None),
    ],
)
def test_remote_slave_separates_errors_from_routing_errors(
    result: int, error: type[Exception], code: AbortCode | None
) -> None:
    slave = Station(result=result).link()
    with pytest.raises(error) as caught:
        run_virtual(slave.read_object(0x1018, 1))
    assert getattr(caught.value, "code", None) == code
    if code is None:
        with pytest.raises(RemoteAccessError):
            run_virtual(slave.probe())
    else:
        run_virtual(slave.probe())


def test_remote_slave_addresses_elements() -> None:
    station = Station(b"1")
    slave = station.link()
    assert run_virtual(slave.read_elements(32, 0x42, drive=3)) == b"1"
    run_virtual(slave.write_elements(32, 0x42, b"1", drive=3))
    run_virtual(slave.send_vendor(b"abc"))
    assert station.asked == [
        Read(IndexGroup.SOE, 0x0342_0020, LONGEST_ANSWER),
        Write(IndexGroup.SOE, 0x0342_0020, b"1"),
        Write(IndexGroup.VOE, 0, b"abc"),
    ]


def test_remote_access_error_names_the_ads_error() -> None:
    assert str(RemoteAccessError(AdsError.TIMEOUT)) == "error 0x719 (no answer in time)"
