"""Services on the buses: conversations, procedures and states, one step after the other."""

from __future__ import annotations

import asyncio
from io import BytesIO

import pytest

from devicebus.errors import AlStatusError, BusError, FrameLostError, MailboxTimeoutError
from devicebus.mailbox import coe_client, foe_client
from devicebus.mailbox.conversation import MailboxRequest
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.diagnosis import diagnose
from devicebus.master.procedure import Sleep, read
from devicebus.wire.alstatus import AlState
from devicebus.wire.register import Register
from eap.codec.mailbox import MailboxType
from eap.errors import EngineGoneError
from eap.od.abort import SdoAbortError
from eap.runtime.engine_messages import Cancel, ExchangeMailbox
from eap.runtime.handover import PortName
from eap.services.engine_link import EngineLink
from eap.services.slaves import bus_client
from eap.services.slaves.bus_client import BusClient
from tests.support.eventually import settle
from tests.support.fakeengine import PORT, FakeBus, FakeEngine, bus_clients
from tests.support.loopbus import LoopBus
from tests.support.virtualtime import run_virtual

SENSOR = 1003
DRIVE = 1001


def play(scene, name="coe"):
    """Run *scene* with a client and the engine it asks."""

    async def run():
        engine = FakeEngine(FakeBus(LoopBus(name)))
        link = EngineLink(engine.services, silence_limit_s=0.05)
        try:
            async with asyncio.timeout(20):
                return await scene(BusClient(link, 0, PORT), engine)
        finally:
            link.close()
            engine.close()

    return run_virtual(run())


def vendor():
    return coe_client.upload(0x1018, 1)


def test_bus_client_describes_slaves():
    async def scene(client, engine):
        report = await client.describe()
        assert [each.name for each in report.slaves] == ["coupler", "buttons", "sensor"]

    play(scene)


def test_bus_client_converses_with_slaves():
    async def scene(client, engine):
        assert await client.converse(SENSOR, vendor(), "me") == b"\x5a\x0e\0\0"
        with pytest.raises(SdoAbortError):
            await client.converse(SENSOR, coe_client.upload(0x5555, 0), "me")
        with pytest.raises(BusError, match="unknown slave 1009"):
            await client.converse(1009, vendor(), "me")

    play(scene)


def test_conversation_of_no_step():
    async def scene(client, engine):
        def nothing():
            if False:
                yield
            return 7

        assert await client.converse(SENSOR, nothing(), "me") == 7
        assert not engine.of(ExchangeMailbox)

    play(scene)


def test_whole_object_in_segments():
    async def scene(client, engine):
        assert len(await client.converse(SENSOR, coe_client.upload(0x8001, 0), 1)) == 2048
        assert len(engine.of(ExchangeMailbox)) > 5

    play(scene)


def test_errors_keep_their_class_in_a_conversation():
    async def scene(client, engine):
        engine.buses[0].line.fault(kind="mailbox", slave="sensor")
        seen = []

        def stubborn():
            try:
                yield MailboxRequest(MailboxType.COE, bytes(10), timeout_ns=5_000_000)
            except MailboxTimeoutError as exc:
                seen.append(exc)
            return "done"

        assert await client.converse(SENSOR, stubborn(), "me") == "done"
        assert "no COE reply within 5 ms" in str(seen[0])

    play(scene)


def test_one_transfer_at_a_time_and_requesters_take_turns():
    order = []

    async def scene(client, engine):
        async def use(requester):
            value = await client.converse(SENSOR, coe_client.upload(0x8001, 0), requester)
            assert len(value) == 2048
            order.append(requester)

        async with asyncio.TaskGroup() as group:
            for requester in "aaab":
                group.create_task(use(requester))

    play(scene)
    assert order == ["a", "a", "b", "a"]


def test_file_and_objects_at_once():
    content = bytes(range(256)) * 800

    async def scene(client, engine):
        sizes = MailboxSizes(*_sizes(await client.describe()))
        write = foe_client.write("firmware.bin", BytesIO(content).read, sizes)
        written = asyncio.ensure_future(client.converse(DRIVE, write, "file"))
        reads = 0
        while not written.done():
            assert await client.converse(DRIVE, vendor(), "objects") == b"\x5a\x0e\0\0"
            reads += 1
        assert (await written, reads > 5) == (len(content), True)
        back = bytearray()
        await client.converse(DRIVE, foe_client.read("firmware.bin", back.extend, sizes), 1)
        assert back == content

    play(scene, "drive")


def _sizes(report):
    return report.slaves[0].to_slave, report.slaves[0].to_master


def test_client_that_leaves_in_a_file_frees_the_slave():
    async def scene(client, engine):
        sizes = MailboxSizes(*_sizes(await client.describe()))
        write = foe_client.write("firmware.bin", bytes, sizes)  # a file without an end
        writing = asyncio.ensure_future(client.converse(DRIVE, write, "file"))
        await engine.wait_for(20)
        engine.holds = True
        await settle()
        writing.cancel()
        with pytest.raises(asyncio.CancelledError):
            await writing
        await settle()
        asked = [each for each in engine.requests if isinstance(each, (ExchangeMailbox, Cancel))]
        assert isinstance(asked[-2], Cancel)
        assert (asked[-1].request.type, asked[-1].request.expects_reply) == (MailboxType.FOE, False)
        engine.release()
        back = bytearray()
        await client.converse(DRIVE, foe_client.read("firmware.bin", back.extend, sizes), 1)
        assert back
        assert 0 not in back  # as it was before

    play(scene, "drive")


def test_turn_that_was_not_used_is_given_back_without_a_word():
    async def scene(client, engine):
        talk = await client.lock_mailbox(DRIVE, MailboxType.FOE, 1)
        talk.abandon()
        talk.close()
        await asyncio.wait_for(client.lock_mailbox(DRIVE, MailboxType.FOE, 2), 1)
        assert not engine.of(ExchangeMailbox)

    play(scene, "drive")


def test_bus_client_runs_procedures():
    async def scene(client, engine):
        octets = await client.run(read(SENSOR, Register.STATION_ADDRESS, 2))
        assert int.from_bytes(octets, "little") == SENSOR
        found = await client.run(diagnose([1001, 1002, SENSOR]))
        assert all(slave.answers for slave in found.slaves)

        def sleeper():
            _, before_ns = yield Sleep(0)
            _, now_ns = yield Sleep(10_000_000)
            return now_ns - before_ns

        assert await client.run(sleeper()) >= 10_000_000
        engine.buses[0].line.fault(kind="loss")
        with pytest.raises(FrameLostError):
            await client.run(read(SENSOR, Register.TYPE, 1))

    play(scene)


def test_bus_client_brings_slaves_to_states():
    async def scene(client, engine):
        await client.bring(0, AlState.INIT)
        await client.bring(SENSOR, AlState.PREOP)
        states = [each.state for each in (await client.describe()).slaves]
        assert states == [AlState.INIT, AlState.INIT, AlState.PREOP]
        engine.buses[0].line.fault(kind="refuse", slave="buttons", state="PREOP", code=0x51)
        with pytest.raises(AlStatusError, match="EEPROM error") as caught:
            await client.bring(1002, AlState.PREOP)
        assert (caught.value.code, caught.value.state) == (0x51, AlState.INIT)

    play(scene)


def test_bus_that_is_not_up_is_waited_for(monkeypatch):
    async def scene(client, engine):
        engine.buses[0].is_up = False
        asyncio.get_running_loop().call_later(0.1, setattr, engine.buses[0], "is_up", True)
        assert await client.converse(SENSOR, vendor(), 1) == b"\x5a\x0e\0\0"
        engine.buses[0].is_up = False
        engine.say_hello()
        await settle()
        monkeypatch.setattr(bus_client, "BUS_WAIT_UP_S", 0.1)
        with pytest.raises(BusError, match="left/bus0 is not up: no frame comes back"):
            await client.converse(SENSOR, vendor(), 1)
        assert not (await client.describe()).is_up

    play(scene)


def test_faults_of_a_slave_and_of_its_bus():
    async def scene(client, engine):
        assert await client.find_faults(SENSOR) == []
        engine.buses[0].is_up = False
        engine.say_hello()
        await settle()
        (fault,) = await client.find_faults(SENSOR)
        assert fault.startswith("left/bus0 is not up: no frame comes back")
        engine.holds = True
        (fault,) = await client.find_faults(SENSOR)
        assert fault.startswith("left/bus0: ")

    play(scene)


def test_engine_that_is_gone(monkeypatch):
    async def scene(client, engine):
        await client.wait_up()
        engine.holds = True
        with pytest.raises(EngineGoneError):
            await client.converse(SENSOR, vendor(), 1)
        with pytest.raises(EngineGoneError):
            await client.describe(0.05)
        monkeypatch.setattr(bus_client, "BUS_WAIT_UP_S", 0.1)
        with pytest.raises(EngineGoneError):
            await client.wait_up()

    play(scene)


def test_bus_clients_request_their_buses_by_number():
    async def run():
        engine = FakeEngine(FakeBus(LoopBus("drive")), FakeBus(LoopBus("coe")))
        link = EngineLink(engine.services)
        second = PortName("left", "bus1")
        try:
            clients = bus_clients(link, PORT, second)
            found = {port: len((await each.describe()).slaves) for port, each in clients.items()}
            assert found == {PORT: 1, second: 3}
            assert [each.bus for each in engine.requests] == [0, 1]
            assert len((await clients[second].view.current()).slaves) == 3
            assert PortName("left", "eap0") not in clients
        finally:
            link.close()
            engine.close()

    run_virtual(run())
