"""Access to a slave of an own bus, with the engine and the slaves in the test's loop."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import pytest
from msgspec.structs import replace

from devicebus.errors import MailboxBusyError, NoMailboxError, SoeError
from devicebus.mailbox.conversation import MailboxRequest
from eap.codec.coe import ListRequest, SdoInfoOpcode
from eap.codec.mailbox import MailboxType
from eap.codec.soe import Element, Idn
from eap.errors import EngineGoneError
from eap.od.abort import AbortCode, SdoAbortError
from eap.runtime.engine_messages import ExchangeMailbox
from eap.services.engine_link import EngineLink
from eap.services.slaves.access import LocalSlave, SlaveAccess
from eap.services.slaves.bus_client import BusClient
from tests.support.eventually import eventually
from tests.support.fakeengine import PORT, FakeBus, FakeEngine
from tests.support.loopbus import LoopBus
from tests.support.virtualtime import run_virtual

CONTROLWORD, NO_OBJECT, CALIBRATION = 0x6040, 0x5555, 0x8001
ABORT = 4


def play(
    scene: Callable[[SlaveAccess, FakeEngine], Awaitable[None]],
    *,
    bus: str = "drive",
    lock_s: float | None = None,
    **fields: int,
) -> None:
    async def run() -> None:
        engine = FakeEngine(FakeBus(LoopBus(bus)))
        link = EngineLink(engine.services)
        mailboxes = BusClient(link, 0, PORT)
        try:
            found, *_ = (await mailboxes.view.current()).slaves.values()
            slave = replace(found, **fields)
            await scene(LocalSlave(mailboxes, slave, "me", lock_s=lock_s), engine)
        finally:
            link.close()
            engine.close()

    run_virtual(run())


def test_local_slave_reads_and_writes_objects() -> None:
    async def scene(slave: SlaveAccess, engine: FakeEngine) -> None:
        vendor = await slave.read_object(0x1018, 1)
        assert vendor == bytes.fromhex("5a0e0000")
        stream = await slave.open_object(0x1018, 1)
        assert (stream.size, await stream.read(9)) == (4, vendor)
        await slave.write_object(CONTROLWORD, 0, b"\6\0")
        await slave.write_unsized(CONTROLWORD, 0, b"\7\0\0\0")
        assert await slave.read_object(CONTROLWORD, 0) == b"\7\0"
        assert (await slave.sizes()).to_slave == 1024

    play(scene)


def test_local_slave_reads_a_long_object_beside_its_reader() -> None:
    async def scene(slave: SlaveAccess, engine: FakeEngine) -> None:
        stream = await slave.open_object(CALIBRATION, 0)
        assert stream.size == 2048
        assert await stream.read(500) == bytes(500)
        assert await slave.read_object(0x1018, 1), "another operation had its turn"
        assert await stream.read(5000) == bytes(1548)
        assert await stream.read(1) == b""
        stream.close()

    play(scene, bus="coe", station=1003)


def test_local_slave_upload_that_is_closed_is_aborted_at_the_slave() -> None:
    async def scene(slave: SlaveAccess, engine: FakeEngine) -> None:
        stream = await slave.open_object(CALIBRATION, 0)
        stream.close()
        await eventually(lambda: engine.of(ExchangeMailbox)[-1].request.request[2] >> 5 == ABORT)
        assert await slave.read_object(0x1018, 1)

    play(scene, bus="coe", station=1003)


def test_local_slave_upload_that_fails_ends_with_its_error() -> None:
    async def scene(slave: SlaveAccess, engine: FakeEngine) -> None:
        stream = await slave.open_object(CALIBRATION, 0)
        engine.buses[0].is_up = False
        engine.say_hello()
        with pytest.raises(EngineGoneError):
            await stream.read(5000)
        stream.close()

    play(scene, bus="coe", station=1003)


def test_local_slave_refusals_keep_the_slaves_codes() -> None:
    async def scene(slave: SlaveAccess, engine: FakeEngine) -> None:
        with pytest.raises(SdoAbortError) as aborted:
            await slave.read_object(NO_OBJECT, 0)
        assert aborted.value.code == AbortCode.NO_OBJECT
        with pytest.raises(SoeError) as refused:
            await slave.read_elements(0x7FFF, Element.VALUE, drive=0)
        assert refused.value.code == 0x1001

    play(scene)


def test_local_slave_reads_descriptions_and_elements() -> None:
    async def scene(slave: SlaveAccess, engine: FakeEngine) -> None:
        found = await slave.read_info(SdoInfoOpcode.LIST_REQUEST, ListRequest(1).encode())
        assert (0x1018).to_bytes(2, "little") in found
        idn = Idn.parse("S-0-0032").number
        await slave.write_elements(idn, Element.VALUE, b"\2\0\0\0", drive=0)
        assert await slave.read_elements(idn, Element.VALUE, drive=0) == b"\2\0\0\0"

    play(scene)


def test_local_slave_passes_messages_of_vendors() -> None:
    async def scene(slave: SlaveAccess, engine: FakeEngine) -> None:
        message = bytes.fromhex("64110000 0100 0102")
        assert await slave.exchange_vendor(message) == message
        reply = await slave.exchange(MailboxType.EOE, bytes.fromhex("06000000"))
        assert reply.data[0] & 0x0F == 7

    play(scene)


def test_local_slave_without_turn_is_busy() -> None:
    async def scene(slave: SlaveAccess, engine: FakeEngine) -> None:
        assert isinstance(slave, LocalSlave)
        other = await slave.bus.lock_mailbox(1001, MailboxType.COE, "other")
        with pytest.raises(MailboxBusyError):
            await slave.read_object(0x1018, 1)
        request = bytes.fromhex("0020 40 1810 01 00000000")
        await other.exchange(MailboxRequest(MailboxType.COE, request))
        other.close()
        assert await slave.read_object(0x1018, 1)

    play(scene, lock_s=0.01)


def test_local_slave_without_mailbox_has_no_sizes() -> None:
    async def scene(slave: SlaveAccess, engine: FakeEngine) -> None:
        with pytest.raises(NoMailboxError):
            await slave.sizes()

    play(scene, to_slave=0, to_master=0)
