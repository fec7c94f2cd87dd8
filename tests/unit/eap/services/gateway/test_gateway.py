"""A gateway with a real bus client behind it, and slaves in memory."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable

import pytest
from msgspec.structs import replace

from devicebus.master.mailboxes import Unsolicited
from eap.ads.request import Read
from eap.ams.access import AccessList
from eap.ams.spec import AccessRule, AccessTarget
from eap.codec.ads import IndexGroup
from eap.codec.ethercat import EtherCatHeader
from eap.codec.mailbox import (
    MailboxHeader,
    MailboxType,
    decode_frame,
    encode_frame,
)
from eap.gateway.request_tracker import ClientLimits
from eap.gateway.requests import AddressMap, RemoteAddress, SlaveAddress
from eap.ids import Endpoint, NetId
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RW, array, variable
from eap.runtime.engine_messages import UnsolicitedMessage
from eap.services.engine_link import EngineLink
from eap.services.gateway.gateway import MailboxGateway, Settings
from eap.services.gateway.sessions import MasterSession
from eap.services.slaves.access import SlaveAccess
from eap.services.slaves.bus_client import BusClient
from eap.services.slaves.remote_slave import LONGEST_ANSWER
from tests.support.elsewhere import Station
from tests.support.fakeengine import PORT, FakeBus, FakeEngine
from tests.support.loopbus import LoopBus
from tests.support.vectors import load
from tests.support.virtualtime import run_virtual

COE, FOE, SOE, VOE, AOE, EOE = (
    MailboxType[name] for name in ("COE", "FOE", "SOE", "VOE", "AOE", "EOE")
)
ELSEWHERE_BUS = NetId.parse("127.0.1.2.3.1")
NET_ID = NetId.parse("127.0.1.1.3.1")
HERE, ALSO_HERE = Endpoint("udp:eap0", "127.0.0.1:1"), Endpoint("udp:eap0", "127.0.0.1:2")
ELSEWHERE = Endpoint("udp:eap0", "10.0.0.9:1")
FILE = b"firmware.bin".hex()
VENDOR = "0020 40 1810 01 00000000"
MASTER = ObjectDictionary(
    [
        variable(0x1000, "Device type", "UDINT", value=0x5100),
        variable(0x1008, "Name", "STRING(300)", value="m" * 300),
        array(0xF020, "Addresses", "UINT", [1001, 1002]),
        variable(0x2000, "Anything", "UDINT", RW),
    ]
)


async def nothing(index: int) -> None:
    """All that the dictionary shows is up to date."""


class GatewayHarness:
    """A gateway and its clients.

    Attributes:
        engine: That the slaves belong to.
        bus: The client of that bus.
    """

    def __init__(self, bus: str, rules: tuple[AccessRule, ...], settings: Settings) -> None:
        self.asked: list[RemoteAddress] = []
        self.station = Station(b"\7\0\0\0")
        self.engine = FakeEngine(FakeBus(LoopBus(bus)))
        self._link = EngineLink(self.engine.services)
        turns = itertools.cycle((False, True))  # has to be waited for, and has not
        self.bus = BusClient(self._link, 0, PORT)
        self.gateway = MailboxGateway(
            self.bus,
            lambda: MasterSession(MASTER, settings.max_size, nothing, lambda index: next(turns)),
            lambda: AccessList(rules),
            settings,
            AddressMap({0x9000: SlaveAddress(1001), 0x9001: RemoteAddress(ELSEWHERE_BUS, 1003)}),
            self._open_remote,
        )

    def _open_remote(self, slave: RemoteAddress, answer_s: float) -> SlaveAccess:
        self.asked.append(slave)
        return self.station.link()

    async def handle(
        self, kind: MailboxType, address: int, octets: str | bytes, endpoint: Endpoint = HERE
    ) -> list[tuple[MailboxHeader, bytes]]:
        """Return the answers to a request."""
        body = bytes.fromhex(octets) if isinstance(octets, str) else octets
        frame = encode_frame(MailboxHeader(0, address, type=kind, counter=3), body)
        return [decoded(each) for each in await self.ask_frame(frame, endpoint)]

    async def ask_frame(self, frame: bytes, endpoint: Endpoint = HERE) -> list[bytes]:
        answers: list[bytes] = []
        task = self.gateway.receive(frame, endpoint, answers.append)
        if task is not None:
            await task
        return answers

    async def one(
        self, kind: MailboxType, address: int, octets: str | bytes, endpoint: Endpoint = HERE
    ) -> str:
        """Return the only answer, in hex, of the protocol that was asked."""
        ((header, body),) = await self.handle(kind, address, octets, endpoint)
        assert header.type is kind
        assert header.address == address
        return body.hex(" ")

    async def begin_file(self, body: str, endpoint: Endpoint = HERE) -> str:
        """Return the answer to a request of FoE, when it is another one than BUSY."""
        async with asyncio.timeout(20):
            while (answer := await self.one(FOE, 1001, body, endpoint)).startswith("06"):
                pass
        return answer

    async def write_file(self, name: str, content: bytes, endpoint: Endpoint = HERE) -> None:
        """Write a file of the drive."""
        room = 1024 - 12
        await self.begin_file("02 00 00000000" + name, endpoint)
        for number, at in enumerate(range(0, len(content) + 1, room), 1):
            packet = bytes((3, 0)) + number.to_bytes(4, "little") + content[at : at + room]
            while (answer := await self.one(FOE, 1001, packet, endpoint))[:2] == "06":
                pass
            assert answer == (bytes((4, 0)) + number.to_bytes(4, "little")).hex(" ")

    async def close(self) -> None:
        await self.gateway.close()
        self._link.close()
        self.engine.close()


def decoded(frame: bytes) -> tuple[MailboxHeader, bytes]:
    header, body = decode_frame(frame)
    assert len(frame) == EtherCatHeader.SIZE + MailboxHeader.SIZE + header.length
    return header, bytes(body)


def play(
    scene: Callable[[GatewayHarness], Awaitable[None]],
    *rules: AccessRule,
    bus: str = "drive",
    settings: Settings | None = None,
) -> None:
    async def run() -> None:
        harness = GatewayHarness(bus, rules, settings or Settings(NET_ID))
        try:
            await scene(harness)
        finally:
            await harness.close()

    run_virtual(run())


def test_each_protocol_of_a_slave() -> None:
    async def scene(harness: GatewayHarness) -> None:
        assert await harness.one(COE, 1001, VENDOR) == "00 30 43 18 10 01 5a 0e 00 00"
        assert await harness.one(SOE, 1001, "01 40 2000") == "02 40 20 00 02 00 00 00"
        echo = "64110000 0100 0102"
        assert bytes.fromhex(await harness.one(VOE, 1001, echo)) == bytes.fromhex(echo)
        assert (await harness.one(FOE, 1001, "01 00 00000000" + b"firmware.bin".hex())).startswith(
            "03 00 01 00 00 00 66 69"
        )
        assert await harness.handle(FOE, 1001, "04 00 01000000") == []
        assert (await harness.one(EOE, 1001, "06000000"))[:2] == "07"

    play(scene)


def test_gateway_counts_its_answers() -> None:
    async def scene(harness: GatewayHarness) -> None:
        counters = []
        for _ in range(9):
            ((header, _),) = await harness.handle(COE, 1001, VENDOR)
            counters.append(header.counter)
        assert counters == [(counters[0] - 1 + step) % 7 + 1 for step in range(9)]

    play(scene)


def test_any_upload_command_and_surplus_octets_are_taken() -> None:
    async def scene(harness: GatewayHarness) -> None:
        answer = "00 30 43 18 10 01 5a 0e 00 00"
        assert await harness.one(COE, 1001, "0020 41 1810 01 00000000") == answer
        assert await harness.one(COE, 1001, VENDOR + "00" * 8) == answer
        assert await harness.one(COE, 0x8000 | 1001, VENDOR) == answer

    play(scene)


@pytest.mark.parametrize(
    ("kind", "address", "octets", "answer"),
    [
        (COE, 1009, VENDOR, (COE, "0020 80 1810 01 00000206")),
        (SOE, 1009, "01 40 2000", (SOE, "12 40 2000 0a80")),
        (VOE, 1009, "64110000 0100", (MailboxType.ERR, "0100 0500")),
        (SOE, 1001, "01 40 2000", (SOE, "12 40 2000 0110")),
        (COE, 1001, "0020 40 1810 01" + "00" * 1500, (COE, "0020 80 1810 01 05000106")),
        (COE, 1001, "0020 40 9999 00 00000000", (COE, "0020 80 9999 00 00000206")),
    ],
)
def test_gateway_errors_are_in_the_protocol_of_the_request(kind, address, octets, answer) -> None:
    async def scene(harness: GatewayHarness) -> None:
        ((header, body),) = await harness.handle(kind, address, octets)
        assert (header.type, body) == (answer[0], bytes.fromhex(answer[1]))

    play(scene, bus="coe")


def test_a_slave_without_mailbox() -> None:
    async def scene(harness: GatewayHarness) -> None:
        assert await harness.one(COE, 1001, VENDOR) == "00 20 80 18 10 01 21 00 00 08"

    play(scene, bus="io")


def test_a_slave_that_is_silent_is_answered_for_in_time() -> None:
    async def scene(harness: GatewayHarness) -> None:
        await harness.handle(COE, 1001, VENDOR)
        harness.engine.buses[0].line.fault(kind="mailbox", slave="drive")
        assert await harness.one(COE, 1001, VENDOR) == "00 20 80 18 10 01 00 00 04 05"
        (row,) = harness.gateway.statistics.report()
        assert row["errors"] == {"timeout": 1}
        assert (row["requests"], row["replies"], row["address"]) == (2, 1, 1001)

    play(scene, settings=Settings(NET_ID, answer_s=0.05))


def test_silence_where_it_is_wanted() -> None:
    async def scene(harness: GatewayHarness) -> None:
        assert await harness.handle(COE, 1009, VENDOR) == []
        assert await harness.one(COE, 1001, "0020 40 9999 00 00000000")

    play(scene, settings=Settings(NET_ID, is_silent=True))


def test_an_engine_that_is_gone_is_answered_for_too() -> None:
    async def scene(harness: GatewayHarness) -> None:
        harness.engine.buses[0].is_up = False
        assert await harness.one(COE, 1001, VENDOR) == "00 20 80 18 10 01 00 00 06 06"

    play(scene)


def test_the_masters_dictionary() -> None:
    async def scene(harness: GatewayHarness) -> None:
        assert (
            await harness.one(COE, 0, "0020 40 0010 00 00000000") == "00 30 43 00 10 00 00 51 00 00"
        )
        assert (await harness.one(COE, 0, "0020 40 9999 00 00000000"))[:8] == "00 20 80"
        name = await harness.one(COE, 0, "0020 40 0810 00 00000000")
        assert bytes.fromhex(name).endswith(b"m" * 300)
        assert (await harness.one(COE, 0, "0080 01 00 0000 0100"))[:8] == "00 80 02"
        ((header, body),) = await harness.handle(SOE, 0, "01 40 2000")
        assert (header.type, body) == (SOE, bytes.fromhex("12 40 2000 0110"))
        ((header, body),) = await harness.handle(FOE, 0, "01 00 00000000 66")
        assert (header.type, body[:6]) == (FOE, bytes.fromhex("05 00 00800000"))
        ((header, body),) = await harness.handle(VOE, 0, "64110000 0100")
        assert (header.type, body) == (MailboxType.ERR, bytes.fromhex("0100 0200"))

    play(scene)


def test_all_slaves_answer_for_themselves() -> None:
    async def scene(harness: GatewayHarness) -> None:
        answers = {
            header.address: body.hex() for header, body in await harness.handle(COE, 0xFFFF, VENDOR)
        }
        assert set(answers) == {1001, 1002, 1003}
        assert all(each.startswith("003043181001") for each in answers.values())

    play(scene, bus="coe")


def test_all_slaves_of_a_bus_that_is_down_are_answered_for() -> None:
    async def scene(harness: GatewayHarness) -> None:
        harness.engine.buses[0].is_up = False
        harness.engine.say_hello()
        ((header, body),) = await harness.handle(COE, 0xFFFF, VENDOR)
        assert (header.address, body[-4:]) == (0xFFFF, bytes.fromhex("00000206"))
        assert await harness.one(COE, 1001, VENDOR) == "00 20 80 18 10 01 00 00 06 06"

    play(scene, bus="coe")


def test_changed_addresses_and_settings_are_for_the_next_requests() -> None:
    other = RemoteAddress(ELSEWHERE_BUS, 1004)

    async def scene(harness: GatewayHarness) -> None:
        upload = "0020 40 0180 00 00000000"
        assert (await harness.one(COE, 1003, upload)).startswith("00 30 41")
        await harness.one(COE, 0x9001, VENDOR)
        settings = harness.gateway.settings._replace(is_silent=True, limits=ClientLimits(rate=1))
        addresses = AddressMap({0x9000: SlaveAddress(1001), 0x9001: other})
        harness.gateway.change(settings, addresses)
        await harness.one(COE, 0x9001, VENDOR)  # the first of this second
        assert harness.asked == [RemoteAddress(ELSEWHERE_BUS, 1003), other]
        assert len(harness.gateway.transfers()) == 1  # that with 1003, which is what it was
        assert await harness.handle(COE, 1009, VENDOR) == []  # an error of its own, and too fast

    play(scene, bus="coe")


def test_session_restarts_when_the_mailbox_of_a_slave_changes() -> None:
    upload = "0020 40 0180 00 00000000"

    async def scene(harness: GatewayHarness) -> None:
        assert (await harness.one(COE, 1003, upload)).startswith("00 30 41")
        view = harness.bus.view
        slaves = dict(view.latest.slaves)
        slaves[1003] = replace(slaves[1003], to_slave=64, to_master=64)
        view.latest = view.latest._replace(slaves=slaves)
        answer = bytes.fromhex(await harness.one(COE, 1003, upload))
        assert len(answer) == 64 - 6
        assert len(harness.gateway.transfers()) == 1

    play(scene, bus="coe")


def test_virtual_addresses_of_local_and_remote_slaves() -> None:
    async def scene(harness: GatewayHarness) -> None:
        assert await harness.one(COE, 0x9000, VENDOR) == "00 30 43 18 10 01 5a 0e 00 00"
        assert await harness.one(COE, 0x9001, VENDOR) == "00 30 43 18 10 01 07 00 00 00"
        assert harness.asked == [RemoteAddress(ELSEWHERE_BUS, 1003)]
        (operation,) = harness.station.asked
        assert operation == Read(IndexGroup.SDO, 0x1018_0001, LONGEST_ANSWER)

    rule = AccessRule("no", targets=(AccessTarget(str(ELSEWHERE_BUS), 1003),), allow=False)
    play(scene)

    async def refused(harness: GatewayHarness) -> None:
        assert await harness.one(COE, 0x9001, VENDOR) == "00 20 80 18 10 01 00 00 01 06"
        assert not harness.asked

    play(refused, rule)


def test_errors_are_counted_for_their_client() -> None:
    async def scene(harness: GatewayHarness) -> None:
        await harness.handle(COE, 1009, VENDOR)
        await harness.one(COE, 1001, VENDOR)
        counts = harness.gateway.tracker.counts_of(HERE)
        assert (counts.requests, counts.errors) == (2, 1)

    play(scene)


def test_a_mailbox_error_is_no_request() -> None:
    async def scene(harness: GatewayHarness) -> None:
        frame = encode_frame(MailboxHeader(0, 1001, counter=1), bytes.fromhex("0100 0200"))
        ((header, body),) = [decoded(each) for each in await harness.ask_frame(frame)]
        assert (header.type, body) == (MailboxType.ERR, bytes.fromhex("0100 0400"))

    play(scene)


def test_client_that_only_reads_settings_hears_no_frames() -> None:
    async def scene(harness: GatewayHarness) -> None:
        heard: list[bytes] = []
        frame = encode_frame(MailboxHeader(0, 1001, type=EOE), bytes.fromhex("06000000"))
        task = harness.gateway.receive(frame, HERE, heard.append)
        assert task is not None
        await task
        harness.engine.tell(UnsolicitedMessage(0, Unsolicited(1001, EOE, b"an Ethernet frame")))
        await harness.handle(COE, 1001, VENDOR)
        assert len(heard) == 1  # the answer

    play(scene)


def test_ethernet_frames_of_a_slave_go_to_its_clients() -> None:
    async def scene(harness: GatewayHarness) -> None:
        heard: list[bytes] = []
        frame = encode_frame(
            MailboxHeader(0, 1001, type=EOE), bytes.fromhex("00010000") + bytes(60)
        )
        task = harness.gateway.receive(frame, HERE, heard.append)
        assert task is not None
        await task
        harness.engine.tell(UnsolicitedMessage(0, Unsolicited(1001, EOE, b"an Ethernet frame")))
        harness.engine.tell(UnsolicitedMessage(0, Unsolicited(1001, COE, b"an emergency")))
        harness.engine.tell(UnsolicitedMessage(0, Unsolicited(1002, EOE, b"of another slave")))
        harness.engine.tell(UnsolicitedMessage(1, Unsolicited(1001, EOE, b"of another bus")))
        await harness.handle(COE, 1001, VENDOR)
        (back,) = heard
        header, body = decode_frame(back)
        assert (header.type, header.address, bytes(body)) == (EOE, 1001, b"an Ethernet frame")

    play(scene)


DIALECT = {
    "coe_read_master_0x1018_01": "0020 80 1810 01 00000206",
    "coe_read_slave_0x03e9_0x6040_00": "0030 4b 4060 00 00000000",
    "coe_write_slave_0x03e9_0x6040_00_06_00": "0030 60 4060 00 00000000",
    "soe_read_idn_32_drive0_element_5_value": "02 05 2000",
    "soe_read_idn_32_drive1_element_0_name": "12 08 2000 0910",
    "soe_write_idn_32_1000": "04 05 2000",
    "foe_read_firmware_bin": "03 00000000" + b"firmware 1.0 of a simulated drive".hex(),
    "voe_vendor_0x1164_type_1_data_01_02": "64110000 0100 0102",
}


@pytest.mark.parametrize("name", DIALECT)
def test_requests_of_the_dialect(name) -> None:
    vector = next(each for each in load("high_nibble_dialect") if each.name.endswith(f"/{name}"))

    async def scene(harness: GatewayHarness) -> None:
        (frame,) = await harness.ask_frame(vector.frame)
        assert frame[7] == vector.frame[7]
        assert frame[4:6] == vector.frame[4:6]
        assert frame[8:].startswith(bytes.fromhex(DIALECT[name]))

    play(scene)


def test_dialect_of_a_read_only_client() -> None:
    write = next(each for each in load("high_nibble_dialect") if "coe_write" in each.name)

    async def scene(harness: GatewayHarness) -> None:
        (frame,) = await harness.ask_frame(write.frame, ELSEWHERE)
        assert frame[8:] == bytes.fromhex("0020 80 4060 00 02000106")

    play(scene)
