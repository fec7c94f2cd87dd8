"""ADS services of slaves: objects, elements, vendor messages, states, and slaves with ADS."""

from __future__ import annotations

import pytest

from devicebus.mailbox import aoe_client
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.wire.sii import SiiProtocol
from eap.ads.request import Read, ReadState, ReadWrite, Write, WriteControl
from eap.codec.ads import AdsError, AdsRange, AdsState, IndexGroup, SoeOffset
from eap.codec.ams import AmsCommand, AmsHeader
from eap.codec.coe import EntryDescription, ObjectDescription
from eap.codec.soe import Element, Idn
from eap.ids import NetId
from eap.runtime.engine_messages import ExchangeMailbox
from eap.services.ads import bus_ads
from tests.support.busads import BUS, DRIVE, TOOL, play, until

TALKER, MUTE, OTHER_SLAVE = 1001, 1002, 1002
SENSOR = 1003
IDENTITY = bytes.fromhex("0400 5a0e0000 21560000 00000100 01000000")
MODE = Idn.parse("S-0-0032")
NAME = b"\x16\0\x16\0Primary operation mode"
ATTRIBUTE = bytes.fromhex("01001200")
COMMAND = Idn.parse("S-0-0099")
HEAD = bytes.fromhex("5a0e0000 0700")
OTHER = NetId.parse("9.9.9.9.1.1")


def test_slave_state_is_a_value_of_its_device_data():
    async def scene(client, engine):
        assert await client.read(DRIVE, IndexGroup.DEVICE_DATA, 0) == b"\x0f\0\2\0"
        assert await client.read(DRIVE, IndexGroup.DEVICE_DATA, 2) == b"\2\0"
        wrong = await client.do(DRIVE, WriteControl(AdsState.SHUTDOWN, 0, b""))
        assert wrong.result == AdsError.VALUE

    play(scene)


@pytest.mark.parametrize("group", [IndexGroup.SDO, IndexGroup.SOE, IndexGroup.VOE])
def test_slave_without_the_protocol_of_a_group_is_an_error(group):
    async def scene(client, engine):
        assert (await client.do(MUTE, Read(group, 0, 4))).result == AdsError.SERVICE
        assert "slave 1002 does not speak" in client.why
        assert (await client.do(MUTE, Read(0x1234, 0, 4))).result == AdsError.INDEX_GROUP

    play(scene, "aoe")


def test_group_without_a_service_is_not_sent_as_another_one(monkeypatch):
    monkeypatch.setitem(bus_ads._PROTOCOLS, 0x1234, SiiProtocol.COE)

    async def scene(client, engine):
        assert (await client.do(DRIVE, Read(0x1234, 0, 4))).result == AdsError.INDEX_GROUP

    play(scene)


def test_slave_without_an_open_mailbox_is_answered_with_its_state():
    async def scene(client, engine):
        await client.good(DRIVE, WriteControl(AdsState.INIT, 0, b""))

        async def is_there():
            return (await client.good(DRIVE, ReadState()))[2] == 1

        await until(is_there)
        outcome = await client.do(DRIVE, Read(IndexGroup.SDO, 0x1018_0001, 4))
        assert outcome.result == AdsError.STATE
        assert client.why == "left/bus0/drive: slave 1001 (drive) has no mailbox in INIT"

    play(scene)


def test_slave_that_does_not_answer_is_a_timeout():
    async def scene(client, engine):
        with engine.buses[0].line.lost("other"):

            async def is_gone():
                return (await client.good(OTHER_SLAVE, ReadState())) == bytes(4)

            await until(is_gone)
            outcome = await client.do(OTHER_SLAVE, Read(IndexGroup.SDO, 0x1018_0001, 4))
            assert outcome.result == AdsError.TIMEOUT
            assert client.why == "left/bus0/other: slave 1002 does not answer"

    play(scene, "files")


def test_slave_with_aoe_gets_groups_of_other_protocols():
    async def scene(client, engine):
        assert await client.read(TALKER, IndexGroup.SDO, 0x8002_0000) == b"\7\0\0\0"
        await client.good(TALKER, Write(IndexGroup.SDO, 0x8002_0000, b"\x08\0\0\0"))
        both = ReadWrite(IndexGroup.SDO, 0x8002_0000, 4, b"\x09\0\0\0")
        assert await client.good(TALKER, both) == b"\x09\0\0\0"

    play(scene, "aoe")


def test_objects_are_read_and_written_by_entry():
    async def scene(client, engine):
        assert await client.read(DRIVE, IndexGroup.SDO, 0x1018_0002) == IDENTITY[6:10]
        await client.write(DRIVE, IndexGroup.SDO, 0x6040_0000, b"\6\0")
        assert await client.read(DRIVE, IndexGroup.SDO, 0x6040_0000) == b"\6\0"
        both = await client.ask(DRIVE, IndexGroup.SDO, 0x6040_0000, b"\7\0")
        assert both == b"\7\0"
        assert await client.ask(DRIVE, IndexGroup.SDO, 0x6040_0000) == b"\7\0"

    play(scene)


def test_objects_with_complete_access_ignore_the_subindex():
    async def scene(client, engine):
        for offset in (0x1018_0100, 0x1018_0103, 0x1018_0300):  # the last with a long time-out
            assert await client.read(DRIVE, IndexGroup.SDO, offset) == IDENTITY

    play(scene)


def test_objects_are_written_with_complete_access():
    async def scene(client, engine):
        whole = await client.read(SENSOR, IndexGroup.SDO, 0x8000_0100)
        changed = whole[:2] + b"\x33\0\0\0" + whole[6:]
        await client.write(SENSOR, IndexGroup.SDO, 0x8000_0100, changed)
        assert await client.read(SENSOR, IndexGroup.SDO, 0x8000_0001) == b"\x33\0\0\0"

    play(scene, "coe")


def test_objects_longer_than_a_mailbox_go_in_segments():
    value = bytes(range(256)) * 8

    async def scene(client, engine):
        await client.write(SENSOR, IndexGroup.SDO, 0x8001_0000, value)
        assert await client.read(SENSOR, IndexGroup.SDO, 0x8001_0000) == value

    play(scene, "coe")


def test_descriptions_come_without_headers_of_sdo_information():
    async def scene(client, engine):
        counts = await client.read(DRIVE, IndexGroup.OBJECT_LIST, 0)
        assert (len(counts), counts[:2]) == (12, b"\0\0")
        everything = await client.read(DRIVE, IndexGroup.OBJECT_LIST, 1 << 16)
        assert everything[:2] == b"\1\0"
        assert (len(everything) - 2) // 2 == int.from_bytes(counts[2:4], "little")
        octets = await client.read(DRIVE, IndexGroup.OBJECT_DESCRIPTION, 0x1018_0000)
        assert ObjectDescription.decode(octets).name == "Identity"
        octets = await client.read(DRIVE, IndexGroup.ENTRY_DESCRIPTION, 0x1018_0001)
        assert EntryDescription.decode(octets).bit_length == 32

    play(scene)


@pytest.mark.parametrize(
    ("operation", "result", "why"),
    [
        (Read(IndexGroup.SDO, 0x5555_0000, 4), AdsError.NOT_FOUND, "(0x06020000)"),
        (Read(IndexGroup.SDO, 0x1018_0077, 4), AdsError.NOT_FOUND, "(0x06090011)"),
        (Write(IndexGroup.SDO, 0x1018_0001, bytes(4)), AdsError.ACCESS, "(0x06010002)"),
        (Write(IndexGroup.SDO, 0x6040_0000, bytes(4)), AdsError.SIZE, "(0x060700"),
        (Read(IndexGroup.SDO, 0x1018_0401, 4), AdsError.INDEX_OFFSET, ""),
        (Read(IndexGroup.OBJECT_LIST, 9 << 16, 40), AdsError.GENERAL, "(0x06040043)"),
        (Write(IndexGroup.OBJECT_LIST, 0, b""), AdsError.INDEX_GROUP, ""),
    ],
)
def test_objects_refused_by_the_slave_are_results_with_the_abort_code(operation, result, why):
    async def scene(client, engine):
        assert (await client.do(DRIVE, operation)).result == result
        assert why in client.why

    play(scene)


def place(idn: Idn, elements: int = 0, **more: int) -> int:
    return int.from_bytes(SoeOffset(idn.number, elements, **more).encode(), "little")


def test_elements_are_read_one_behind_the_other():
    async def scene(client, engine):
        async def read(elements):
            return await client.read(DRIVE, IndexGroup.SOE, place(MODE, elements))

        assert await read(Element.NAME) == NAME
        assert await read(Element.ATTRIBUTE) == ATTRIBUTE
        assert await read(Element.VALUE) == b"\2\0\0\0"
        several = Element.NAME | Element.ATTRIBUTE | Element.VALUE
        assert await read(several) == NAME + ATTRIBUTE + b"\2\0\0\0"

    play(scene)


def test_element_is_written_and_read_in_one_request():
    async def scene(client, engine):
        value = place(MODE, Element.VALUE)
        await client.write(DRIVE, IndexGroup.SOE, value, b"\3\0\0\0")
        assert await client.ask(DRIVE, IndexGroup.SOE, value) == b"\3\0\0\0"

    play(scene)


@pytest.mark.parametrize(
    ("operation", "result", "why"),
    [
        (Read(IndexGroup.SOE, place(Idn(True, 7, 4000), 0x40), 4), AdsError.NOT_FOUND, "0x1001"),
        (Read(IndexGroup.SOE, place(MODE, Element.UNIT), 4), AdsError.NOT_FOUND, "0x4001"),
        (Read(IndexGroup.SOE, place(MODE, 0x40, drive=5), 4), AdsError.NOT_FOUND, "0x800A"),
        (Write(IndexGroup.SOE, place(MODE, Element.NAME), b"\1\0\1\0a"), AdsError.ACCESS, "0x2004"),
        (Read(IndexGroup.SOE, place(MODE, 0x40, reserved=1), 4), AdsError.INDEX_OFFSET, ""),
        (Write(IndexGroup.SOE, place(MODE, is_command=1), b"\7\0"), AdsError.VALUE, "by 3"),
    ],
)
def test_elements_refused_by_the_drive_are_results_with_its_code(operation, result, why):
    async def scene(client, engine):
        assert (await client.do(DRIVE, operation)).result == result
        assert why in client.why

    play(scene)


def test_procedure_command_is_executed_and_cleared():
    async def scene(client, engine):
        command = place(COMMAND, is_command=1)
        await client.write(DRIVE, IndexGroup.SOE, command)
        assert await client.read(DRIVE, IndexGroup.SOE, command) == b"\0\0"
        await client.write(DRIVE, IndexGroup.SOE, command, b"\3\0")

    play(scene)


def test_procedure_command_that_takes_long_is_busy_until_it_is_done(monkeypatch):
    monkeypatch.setattr(bus_ads, "COMMAND_ANSWER_S", 0.001)

    async def scene(client, engine):
        command = Write(IndexGroup.SOE, place(COMMAND, is_command=1), b"")
        assert (await client.do(DRIVE, command)).result == AdsError.BUSY
        assert client.why == "left/bus0/drive: S-0-0099 is being executed: repeat the request"
        value = await client.read(DRIVE, IndexGroup.SOE, place(MODE, Element.VALUE))
        assert value == b"\2\0\0\0"  # the drive can be talked to meanwhile

        async def is_done():
            outcome = await client.do(DRIVE, command)
            assert outcome.result in {AdsError.NONE, AdsError.BUSY}
            return not outcome.result

        await until(is_done)

    play(scene)


def test_procedure_command_refused_by_the_drive_leaves_nothing_behind():
    async def scene(client, engine):
        home = Write(IndexGroup.SOE, place(Idn.parse("S-0-0148"), is_command=1), b"")
        for _ in range(2):  # nothing of the first is left
            assert (await client.do(DRIVE, home)).result == AdsError.STATE
            assert "cannot be executed now" in client.why

    play(scene)


def test_procedure_commands_are_limited_in_number(monkeypatch):
    monkeypatch.setattr(bus_ads, "MAX_COMMANDS", 0)

    async def scene(client, engine):
        command = Write(IndexGroup.SOE, place(COMMAND, is_command=1), b"")
        assert (await client.do(DRIVE, command)).result == AdsError.NO_MEMORY

    play(scene)


def test_vendor_message_is_answered_with_its_header():
    async def scene(client, engine):
        assert await client.ask(DRIVE, IndexGroup.VOE, 0, HEAD + b"hello") == HEAD + b"hello"
        assert await client.ask(DRIVE, IndexGroup.VOE, 0, HEAD) == HEAD

    play(scene)


def test_vendor_message_that_is_written_expects_no_answer():
    async def scene(client, engine):
        await client.write(DRIVE, IndexGroup.VOE, 0, HEAD + b"hello")
        (sent,) = engine.of(ExchangeMailbox)
        assert (sent.request.request, sent.request.expects_reply) == (HEAD + b"hello", False)

    play(scene)


def test_vendor_message_without_a_whole_header_is_refused():
    async def scene(client, engine):
        for operation in (Write(IndexGroup.VOE, 0, HEAD[:5]), ReadWrite(IndexGroup.VOE, 0, 9, b"")):
            assert (await client.do(DRIVE, operation)).result == AdsError.SIZE
        assert (await client.do(DRIVE, Read(IndexGroup.VOE, 0, 9))).result == AdsError.SERVICE

    play(scene)


def asked(engine) -> list[AmsHeader]:
    return [AmsHeader.decode(each.request.request) for each in engine.of(ExchangeMailbox)]


def test_aoe_slave_gets_its_address_once():
    async def scene(client, engine):
        number = Read(IndexGroup.SDO, 0x8002_0000, 4)
        assert await client.good(TALKER, number) == b"\7\0\0\0"
        assert await client.good(TALKER, number) == b"\7\0\0\0"
        told, *requests = asked(engine)
        assert (told.target, told.target_port) == (told.source, told.source_port) == (BUS, TALKER)
        sources = {(each.source, each.source_port) for each in requests}
        assert sources == {(TOOL, 30000)}
        assert len({each.invoke_id for each in requests}) == 2

    play(scene, "aoe")


def test_aoe_packets_longer_than_the_mailbox_go_in_fragments():
    value = bytes(range(250)) * 2

    async def scene(client, engine):
        await client.write(TALKER, IndexGroup.SDO, 0x8001_0000, value)
        assert await client.read(TALKER, IndexGroup.SDO, 0x8001_0000) == value

    play(scene, "aoe")


def test_aoe_results_of_the_slave_come_back():
    async def scene(client, engine):
        for operation, result in (
            (Read(IndexGroup.SDO, 0x5555_0000, 4), AdsError.NOT_FOUND),
            (Write(IndexGroup.SDO, 0x8002_0000, b"\1"), AdsError.GENERAL),
            (Read(0x12345, 0, 4), AdsError.INDEX_GROUP),
        ):
            assert (await client.do(TALKER, operation)).result == result

    play(scene, "aoe")


def test_aoe_slave_that_forgot_its_address_gets_it_again():
    async def scene(client, engine):
        number = Read(IndexGroup.SDO, 0x8002_0000, 4)
        assert await client.good(TALKER, number) == b"\7\0\0\0"
        report = await client.bus.describe()
        stranger = AmsHeader(OTHER, TALKER, OTHER, TALKER, AmsCommand.WRITE, length=18)
        told = AdsRange(IndexGroup.ADDRESS, 3, 6).encode() + bytes(OTHER)
        sizes = MailboxSizes(report.slaves[0].to_slave, report.slaves[0].to_master)
        renamed = aoe_client.exchange(stranger, told, sizes)
        await client.bus.converse(TALKER, renamed, "somebody")
        assert await client.good(TALKER, number) == b"\7\0\0\0"

    play(scene, "aoe")
