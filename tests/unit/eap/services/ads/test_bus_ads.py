"""ADS behind the NetID of a bus port: master and slaves, authorized and in time."""

from __future__ import annotations

import asyncio
import random
from time import monotonic_ns

import pytest

from eap.ads.request import (
    OperationOutcome,
    Read,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
    Write,
    WriteControl,
)
from eap.codec.ads import (
    AdsDeviceInfo,
    AdsError,
    AdsRange,
    AdsReadWrite,
    AdsState,
    AdsStates,
    IndexGroup,
    device_name,
)
from eap.codec.adsnotification import AddNotification, TransMode
from eap.codec.ams import AmsCommand, AmsHeader
from eap.codec.mailbox import MailboxType
from eap.runtime.bus_status import report_findings
from eap.runtime.engine_messages import ExchangeMailbox
from eap.services.ads import bus_ads as service
from eap.services.ads import slave_files
from eap.services.device.master_values import MasterView
from eap.services.routing.service import LocalRequest
from tests.support.busads import BUS, DRIVE, MASTER, TOOL, play, until

VENDOR = Read(IndexGroup.SDO, 0x1018_0001, 4)
VENDOR_ID = b"\x5a\x0e\0\0"
SENSOR = 1003
COMMAND = bytes.fromhex("01ff 0000 0000 0400 0000 00000000 0000")
"""As AdsLib sends it, to count slaves."""


def sum_of(group: int, *items: Read | Write) -> ReadWrite:
    heads = b"".join(
        AdsRange(each[0], each[1], each[2] if isinstance(each, Read) else len(each[2])).encode()
        for each in items
    )
    data = b"".join(each.data for each in items if isinstance(each, Write))
    return ReadWrite(group, len(items), 1000, heads + data)


def test_service_answers_for_a_slave_at_its_address():
    async def scene(client, engine):
        assert await client.good(DRIVE, VENDOR) == VENDOR_ID
        assert await client.good(DRIVE, ReadState()) == AdsStates(AdsState.CONFIG, 2).encode()
        info = AdsDeviceInfo.decode(await client.good(DRIVE, ReadDeviceInfo()))
        assert info == AdsDeviceInfo(0, 1, 0, device_name("drive"))

    play(scene)


def test_request_to_a_slave_costs_one_engine_round_trip():
    async def scene(client, engine):
        await client.good(DRIVE, VENDOR)
        engine.requests.clear()
        for _ in range(20):
            assert await client.good(DRIVE, VENDOR) == VENDOR_ID
        assert [type(each) for each in engine.requests] == 20 * [ExchangeMailbox]
        engine.requests.clear()
        for operation in (ReadState(), ReadDeviceInfo()):
            await client.good(DRIVE, operation)
            await client.good(MASTER, operation)
        assert not engine.requests

    play(scene)


def test_service_answers_for_the_master_at_port_0xffff():
    async def scene(client, engine):
        info = AdsDeviceInfo.decode(await client.good(MASTER, ReadDeviceInfo()))
        assert info.name == device_name("left/bus0")
        assert await client.good(MASTER, ReadState()) == AdsStates(AdsState.CONFIG, 2).encode()
        found = await client.read(MASTER, IndexGroup.SLAVE_ADDRESSES, 0)
        assert found == b"".join(n.to_bytes(2, "little") for n in (1001, 1002, 1003))

    play(scene, "coe")


def test_master_shows_its_dictionary():
    async def scene(client, engine):
        assert (
            await client.read(MASTER, IndexGroup.SDO, 0x1008 << 16) == b"EtherCAT master left/bus0"
        )
        assert await client.read(MASTER, IndexGroup.SDO, 0x8002_0001) == b"\xeb\3"
        whole = await client.read(MASTER, IndexGroup.SDO, 0xF020_0100)
        assert whole.hex() == "0300" + "e903ea03eb03"
        lists = await client.read(MASTER, IndexGroup.OBJECT_LIST, 1 << 16)
        assert b"\x02\xa0" in lists
        described = await client.read(MASTER, IndexGroup.OBJECT_DESCRIPTION, 0xA000 << 16)
        assert described.endswith(b"Diagnosis data slave 0")
        entry = await client.read(MASTER, IndexGroup.ENTRY_DESCRIPTION, 0xA000_0002)
        assert entry.endswith(b"AL control")
        missing = await client.do(MASTER, Read(IndexGroup.SDO, 0x8003_0001, 4))
        assert missing.result == AdsError.NOT_FOUND

    play(scene, "coe")


def test_master_dictionary_shows_states_and_scans_as_they_are():
    async def scene(client, engine):
        await client.good(MASTER, Write(IndexGroup.SDO, 0xA000_0002, b"\1\0"))

        async def is_init():
            return await client.read(MASTER, IndexGroup.SDO, 0xA000_0001) == b"\1\0"

        await until(is_init)
        request = Write(IndexGroup.SDO, 0xF002_0001, b"\0\0")
        await client.good(MASTER, request)

        async def is_found():
            found = await client.read(MASTER, IndexGroup.SDO, 0xF002_0003)
            return found == bytes((1, 0, 0, 0, 1, 0))

        await until(is_found)

    play(scene)


def test_notifications_refresh_only_objects_that_they_show(monkeypatch):
    looked_at = []
    refresh = MasterView.refresh

    async def note(provider, index):
        looked_at.append(index)
        await refresh(provider, index)

    async def scene(client, engine):
        there, missing = (
            AddNotification(IndexGroup.SDO, offset, 2, TransMode.SERVER_CYCLE, 0, 0)
            for offset in (0x8002_0001, 0x8003_0001)
        )
        assert (await client.do(MASTER, missing)).result == AdsError.NOT_FOUND
        await client.good(MASTER, there)
        looked_at.clear()

        async def is_looked_at():
            return len(looked_at) > 1

        await until(is_looked_at)
        assert set(looked_at) == {0x8002}

    monkeypatch.setattr(MasterView, "refresh", note)
    play(scene, "coe")


def test_states_are_requested_of_master_and_slaves():
    async def scene(client, engine):
        await client.good(MASTER, WriteControl(AdsState.INIT, 0, b""))
        await until_state(client, 1)
        await client.good(DRIVE, WriteControl(AdsState.CONFIG, 0, b""))
        await until_state(client, 2)
        await client.write(MASTER, IndexGroup.SLAVE_STATES, DRIVE, b"\1\0")
        await until_state(client, 1)
        await client.write(MASTER, IndexGroup.MASTER_STATE, 2)
        await until_state(client, 2)

    play(scene)


async def until_state(client, state):
    async def is_there():
        return (await client.good(DRIVE, ReadState()))[2] == state

    await until(is_there)


def test_raw_command_counts_the_slaves():
    async def scene(client, engine):
        answer = await client.ask(MASTER, IndexGroup.RAW_COMMAND, 0, COMMAND, len(COMMAND))
        assert answer[2:4] == b"\3\0"  # what AdsLib takes for the number of slaves
        assert answer[-2:] == b"\1\0"
        short = await client.do(MASTER, ReadWrite(IndexGroup.RAW_COMMAND, 0, 4, COMMAND))
        assert short.result == AdsError.SIZE

    play(scene, "coe")


def test_port_without_a_slave_is_refused_with_the_known_ones():
    async def scene(client, engine):
        answer = await client.answer(1009, AmsCommand.READ_STATE, b"")
        assert answer[:2] == (b"", AdsError.TARGET_PORT)
        assert answer.why == "left/bus0 has no slave 1009; known slaves: 1001"
        assert (await client.answer(DRIVE, 77, b"")).error_code == AdsError.COMMAND
        assert (await client.answer(DRIVE, AmsCommand.READ, b"")).data[:4] == b"\5\7\0\0"

    play(scene)


def test_bus_that_is_down_is_host_unreachable():
    async def scene(client, engine):
        engine.buses[0].is_up = False
        answer = await client.answer(DRIVE, AmsCommand.READ, AdsRange(*VENDOR).encode())
        assert answer[:2] == (b"", AdsError.HOST_UNREACHABLE)
        assert answer.why == "left/bus0 is not up: no frame comes back"
        assert (await client.do(MASTER, ReadState())).data == b"\3\0\1\0"
        raw = await client.do(MASTER, ReadWrite(IndexGroup.RAW_COMMAND, 0, 16, COMMAND))
        assert raw.result == AdsError.HOST_UNREACHABLE

    play(scene)


def test_bus_without_frames_is_host_unreachable_with_the_words_of_its_finding():
    async def scene(client, engine):
        await client.good(DRIVE, VENDOR)
        bus = engine.buses[0]
        bus.line.fault(kind="loss")
        await until(lambda: _is_silent(client))
        answer = await client.answer(DRIVE, AmsCommand.READ, AdsRange(*VENDOR).encode())
        assert answer[:2] == (b"", AdsError.HOST_UNREACHABLE)
        finding = report_findings(bus.report())[0]
        assert answer.why == f"left/bus0: {finding.what}; {finding.advice}"

    play(scene)


async def _is_silent(client) -> bool:
    return (await client.bus.view.confirm()).is_silent


def test_request_that_waited_behind_others_has_the_rest_of_its_time(monkeypatch):
    async def scene(client, engine):
        header = AmsHeader(BUS, DRIVE, TOOL, 30000, AmsCommand.READ, length=12)
        waited = LocalRequest(
            header, AdsRange(*VENDOR).encode(), client.endpoint, 2, monotonic_ns()
        )
        assert (await client.service.answer(waited)).data[8:] == VENDOR_ID
        monkeypatch.setattr(service, "BUS_REQUEST_S", 0.0)
        engine.requests.clear()
        late = await client.service.answer(waited)
        assert late.data[:4] == b"\x19\7\0\0"
        assert late.why == (
            "left/bus0: waited 0.0 s behind 2 other requests of this client:"
            " port 1001 got no request; send fewer at a time"
        )
        assert not engine.requests

    play(scene)


def test_engine_that_is_gone_is_host_unreachable():
    async def scene(client, engine):
        engine.holds = True
        answer = await client.answer(MASTER, AmsCommand.READ_STATE, b"")
        assert answer.error_code == AdsError.HOST_UNREACHABLE
        assert "engine" in answer.why

    play(scene)


def test_sum_command_has_a_result_for_each_item():
    async def scene(client, engine):
        items = VENDOR, Read(IndexGroup.SDO, 0x5555_0000, 4), Read(0x9999, 0, 2)
        found = await client.good(DRIVE, sum_of(IndexGroup.SUM_READ, *items))
        not_passed_on = await client.do(DRIVE, items[2])
        results = b"".join(n.to_bytes(4, "little") for n in (0, 0x70C, not_passed_on.result))
        assert found == results + VENDOR_ID + bytes(6)
        writes = (
            Write(IndexGroup.SDO, 0x1018_0001, bytes(4)),
            Write(IndexGroup.SDO, 0x607A_0000, b"\5\0\0\0"),
        )
        found = await client.good(DRIVE, sum_of(IndexGroup.SUM_WRITE, *writes))
        assert found == b"\4\7\0\0" + bytes(4)
        assert await client.read(DRIVE, IndexGroup.SDO, 0x607A_0000) == b"\5\0\0\0"

    play(scene)


def test_operation_that_takes_too_long_is_answered_in_time(monkeypatch):
    monkeypatch.setattr(service, "BUS_REQUEST_S", 0.05)

    async def scene(client, engine):
        engine.holds, engine.held_kind = True, ExchangeMailbox
        outcome = await client.do(DRIVE, sum_of(IndexGroup.SUM_READ, VENDOR, VENDOR))
        assert outcome.data[:8] == 2 * b"\x19\7\0\0"
        assert client.why == "; ".join(2 * ["left/bus0: port 1001: not done within 0.05 s"])
        engine.release()
        assert await client.good(DRIVE, VENDOR) == VENDOR_ID

    play(scene)


def test_slave_that_is_busy_does_not_hold_up_others():
    async def scene(client, engine):
        talk = await client.bus.lock_mailbox(1001, MailboxType.COE, "somebody else")
        waiting = asyncio.ensure_future(client.do(1001, VENDOR))
        assert await client.good(SENSOR, VENDOR) == VENDOR_ID
        assert not waiting.done()
        talk.close()
        assert (await waiting).data == VENDOR_ID

    play(scene, "coe")


@pytest.mark.parametrize("length", [0, 3])
def test_answer_longer_than_the_room_of_the_client_is_refused(length):
    async def scene(client, engine):
        outcome = await client.do(DRIVE, VENDOR._replace(length=length))
        assert outcome == OperationOutcome(AdsError.SIZE)
        assert client.why == f"left/bus0/drive: 4 bytes, the client has room for {length}"

    play(scene)


def test_request_of_any_content_is_answered(monkeypatch):
    monkeypatch.setattr(slave_files, "FILE_BLOCK_S", 0.01)
    monkeypatch.setattr(service, "COMMAND_ANSWER_S", 0.01)
    pick = random.Random(7)
    groups = [*IndexGroup, 0, 0x8000_0000]
    offsets = [0, 1, 0x1018_0001, 0x1018_0100, 0x0040_0020, 0x0800_0063, 0xFFFF_FFFF]

    def body(command: int) -> bytes:
        group, offset = pick.choice(groups), pick.choice(offsets)
        data = pick.randbytes(pick.choice((0, 1, 4, 6, 40, 300)))
        length = pick.choice((0, 4, 100, 1 << 20, 0xFFFF_FFFF))
        if command == AmsCommand.READ_WRITE:
            return AdsReadWrite(group, offset, length, len(data)).encode() + data
        return AdsRange(group, offset, length if command == 2 else len(data)).encode() + data

    async def scene(client, engine):
        for number in range(300):
            command = pick.choice((2, 3, 9, 9, pick.randrange(12)))
            port = pick.choice((DRIVE, DRIVE, MASTER, 1002))
            octets = body(command)
            cut = pick.randrange(len(octets)) if not number % 10 else len(octets)
            answer = await client.answer(port, command, octets[:cut])
            assert answer.error_code or len(answer.data) >= 4

    play(scene)
