"""EoE of slaves by ADS, and the reader of a gateway that fetches their frames."""

from __future__ import annotations

import asyncio

import pytest
from scapy.layers.inet import ICMP, IP
from scapy.layers.l2 import ARP, Ether

from devicebus.mailbox.eoe import FrameAssembler
from devicebus.master.mailboxes import Unsolicited
from eap.ads.request import Read, ReadWrite, Write
from eap.ams.access import service_of
from eap.ams.spec import AccessService
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.eoe import EoeType, IpSettings, split_counted
from eap.codec.mailbox import MailboxType
from eap.ids import Endpoint, NetId
from eap.runtime.engine_messages import UnsolicitedMessage
from eap.services.ads import slave_ethernet
from eap.services.gateway import remote_ethernet
from eap.services.gateway.remote_ethernet import RemoteEthernet
from tests.support.busads import DRIVE, Client, play, until
from tests.support.elsewhere import Bus, Station
from tests.support.virtualtime import run_virtual

EOE = IndexGroup.EOE
SETTINGS = IpSettings.decode(bytes.fromhex("03000000 020000000002 0200000a"))
OWN, PEER = "10.0.0.2", "10.0.0.1"
MAC, PEER_MAC = "02:00:00:00:00:02", "02:00:00:00:00:01"
PING = bytes(Ether(src=PEER_MAC, dst=MAC) / IP(src=PEER, dst=OWN) / ICMP() / bytes(1200))
HERE = Endpoint("udp:eap0", "127.0.0.1:1")


async def read(client: Client, reader: int = 1) -> list[Ether]:
    return [Ether(each) for each in await fetch(client, reader, 4096)]


async def fetch(client: Client, reader: int, length: int) -> list[bytes]:
    number = reader.to_bytes(4, "little")
    return split_counted(await client.ask(DRIVE, EOE, 0, number, length))


async def set_ip(client: Client) -> None:
    request = ReadWrite(EOE, EoeType.SET_IP_REQUEST, 64, SETTINGS.encode())
    assert await client.good(DRIVE, request) == bytes.fromhex("0300 0000")


def test_frames_go_to_a_slave_and_come_back():
    async def scene(client, engine):
        assert await read(client) == []
        await set_ip(client)
        await client.write(DRIVE, EOE, 0, PING)
        found = []

        async def is_answered():
            found.extend(await read(client))
            return any(ICMP in each for each in found)

        await until(is_answered)
        announced, pong = found
        assert announced[ARP].psrc == OWN
        assert (pong[ICMP].type, len(pong[ICMP].payload)) == (0, 1200)
        answer = await client.ask(DRIVE, EOE, EoeType.GET_IP_REQUEST, length=64)
        assert IpSettings.decode(answer[4:]).ip == SETTINGS.ip

    play(scene)


def test_each_reader_gets_every_frame():
    async def scene(client, engine):
        other = Client(client.service, client.bus, net_id=NetId.parse("8.8.8.8.1.1"))
        await read(client, 1)
        await read(client, 2)
        await read(other, 1)
        await set_ip(client)

        counts = [0, 0, 0]

        async def is_read():
            for at, (each, reader) in enumerate(((client, 1), (client, 2), (other, 1))):
                counts[at] += len(await read(each, reader))
            return all(counts)

        await until(is_read)
        assert counts == [1, 1, 1]

    play(scene)


def test_reader_is_bounded_and_forgotten(monkeypatch):
    monkeypatch.setattr(slave_ethernet, "MAX_READERS", 2)

    async def scene(client, engine):
        def tell(count: int) -> None:
            for number in range(count):
                data = bytes.fromhex("0001 4000") + bytes((number,)) + bytes(59)
                engine.tell(UnsolicitedMessage(0, Unsolicited(DRIVE, MailboxType.EOE, data)))

        for reader in (1, 2, 3):
            await read(client, reader)
        tell(slave_ethernet.MAX_QUEUED + 6)
        await asyncio.sleep(0.05)
        assert await read(client, 1) == []  # the third one has replaced it
        first = await fetch(client, 3, 2 + 1522)
        assert first[0][0] == 6  # the oldest were dropped
        assert len(first) == 1524 // 62
        monkeypatch.setattr(slave_ethernet, "READER_NS", -1)
        await read(client, 3)
        await fetch(client, 3, 1 << 16)
        tell(1)
        await asyncio.sleep(0.05)
        assert await read(client, 3) == []

    play(scene)


@pytest.mark.parametrize(
    ("operation", "result"),
    [
        (ReadWrite(EOE, 0, 100, bytes(4)), AdsError.SIZE),
        (ReadWrite(EOE, 0, 4096, bytes(3)), AdsError.SIZE),
        (Read(EOE, 0, 4096), AdsError.SERVICE),
        (Write(EOE, 0, bytes(1600)), AdsError.SIZE),
        (Write(EOE, 0, b""), AdsError.SIZE),
        (ReadWrite(EOE, 3, 64, b""), AdsError.INDEX_OFFSET),
        (ReadWrite(EOE, 99, 64, b""), AdsError.INDEX_OFFSET),
    ],
)
def test_wrong_requests_are_refused(operation, result):
    async def scene(client, engine):
        assert (await client.do(DRIVE, operation)).result == result

    play(scene)


def test_slave_without_eoe_refuses_frames():
    async def scene(client, engine):
        assert (await client.do(1001, ReadWrite(EOE, 0, 4096, bytes(4)))).result == AdsError.SERVICE

    play(scene, "files")


def test_broken_fragments_are_ignored():
    async def scene(client, engine):
        await read(client)
        for data in (b"", b"\0", b"\x07\0\0\0", b"\0\1\2\0"):
            engine.tell(UnsolicitedMessage(0, Unsolicited(DRIVE, MailboxType.EOE, data)))
        engine.tell(UnsolicitedMessage(0, Unsolicited(DRIVE, MailboxType.COE, b"\0\x10")))
        await asyncio.sleep(0.05)
        assert await read(client) == []

    play(scene)


@pytest.mark.parametrize(
    ("operation", "service"),
    [
        (ReadWrite(EOE, 0, 4096, bytes(4)), AccessService.RAW),
        (ReadWrite(EOE, EoeType.GET_IP_REQUEST, 64, b""), AccessService.READ),
        (ReadWrite(EOE, EoeType.SET_IP_REQUEST, 64, b""), AccessService.RAW),
        (Write(EOE, 0, PING), AccessService.RAW),
        (Write(EOE, EoeType.GET_IP_REQUEST, PING), AccessService.RAW),
    ],
)
def test_frames_need_the_right_of_raw_access(operation, service):
    assert service_of(operation) is service


def test_gateway_fetches_frames_while_there_are_clients(monkeypatch):
    monkeypatch.setattr(remote_ethernet, "LONGEST_PAUSE_S", 0.02)

    async def scene(client, engine):
        station = Bus(client)
        got: list[bytes] = []
        ethernet = RemoteEthernet("left/bus0", 128, lambda listener, data: got.append(data))
        ethernet.add(0x9001, station.link(), HERE, got.append)
        await until(lambda: asyncio.sleep(0, bool(station.asked)))
        await set_ip(client)
        await client.write(DRIVE, EOE, 0, PING)
        assembler, frames = FrameAssembler(), []

        async def is_answered():
            while got:
                frames.append(assembler.receive(got.pop(0)))
            return any(each is not None and ICMP in Ether(each) for each in frames)

        await until(is_answered)
        assert assembler.dropped == 0
        ethernet.forget(HERE)
        await asyncio.sleep(0.1)
        station.asked.clear()
        await asyncio.sleep(0.1)
        assert station.asked == []
        await ethernet.close()

    play(scene)


def test_gateway_asks_a_station_that_refuses_seldom():
    async def run() -> None:
        station = Station(result=AdsError.SERVICE)
        ethernet = RemoteEthernet("left/bus0", 128, lambda listener, data: None)
        ethernet.add(0x9001, station.link(), HERE, print)
        await asyncio.sleep(0.3)
        assert len(station.asked) <= 2
        await ethernet.close()

    run_virtual(run())
