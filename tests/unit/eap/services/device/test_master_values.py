"""The dictionary of a master and its values, on slaves in memory."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec
import pytest

from devicebus.errors import MailboxTimeoutError
from devicebus.mailbox.conversation import MailboxMessage
from devicebus.wire.register import DlStatus
from devicebus.wire.sii import SiiProtocol
from eap.codec.mailbox import MailboxType
from eap.od.abort import SdoAbortError
from eap.od.model import OdState
from eap.od.profiles.master1100 import MasterLive
from eap.runtime.engine_messages import (
    BringSlaves,
    ExchangeDatagrams,
    ExchangeMailbox,
    SlaveDescription,
)
from eap.services.device import master_values
from eap.services.device.master_values import (
    FRESH_S,
    MasterDictionaryProvider,
    MasterView,
    SlaveFacts,
    configured_value,
    link_status,
)
from eap.services.engine_link import EngineLink
from eap.services.gateway.sessions import MasterSession
from eap.services.slaves.bus_client import BusClient, BusDescription
from tests.support.eventually import elapse, eventually, settle
from tests.support.fakeengine import PORT, FakeBus, FakeEngine
from tests.support.loopbus import LoopBus
from tests.support.virtualtime import run_virtual

CONFIGURED, DIAGNOSIS, LISTS = 0x8000, 0xA000, 0xF020
SLAVE = SlaveDescription(
    station=1001, name="axis", vendor=1, product=2, revision=3, serial=4, alias=0, state=8,
    target=8, order="AX5000", usual_to_slave=256, usual_to_master=128, port_physics=0x31,
    protocols=int(SiiProtocol.COE), link_preset=0x11,
)  # fmt: skip
WIRED = DlStatus(link=0b0011, communication0=1, communication1=1)
TYPE = "0030 43 0010 00 92010200"
HISTORY, NO_HISTORY = "0030 4f f310 00 05000000", "0020 80 f310 00 00000206"


def play(scene: Callable[[MasterView, FakeEngine], Awaitable[None]], bus: str = "io") -> None:
    async def run() -> None:
        engine = FakeEngine(FakeBus(LoopBus(bus)))
        link = EngineLink(engine.services)
        view = MasterView(BusClient(link, 0, PORT))
        try:
            await scene(view, engine)
        finally:
            link.close()
            engine.close()

    run_virtual(run())


def test_view_shows_configured_and_detected_slaves() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        assert view.configured() == ()
        await view.refresh(DIAGNOSIS)
        assert view.configured() == view.detected() == (1001, 1002, 1003, 1004)
        assert view.of_configured(1001, MasterLive.NAME) == "coupler"
        assert view.of_configured(1009, MasterLive.NAME) == ""
        assert view.of_configured(1009, MasterLive.VENDOR) == 0
        assert view.of_detected(1002, MasterLive.DL_STATUS)
        assert view.of_detected(1002, MasterLive.VENDOR) == view.of_configured(
            1002, MasterLive.VENDOR
        )
        assert view.of_diagnosis(1001, MasterLive.AL_STATUS) == 2
        assert view.of_diagnosis(1009, MasterLive.AL_STATUS) == 0
        assert view.of_master(MasterLive.STATE) == 2

    play(scene)


def test_view_shows_the_neighbours_of_ports() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        await view.refresh(DIAGNOSIS)
        ports = (
            MasterLive.NEIGHBOUR_0,
            MasterLive.NEIGHBOUR_1,
            MasterLive.NEIGHBOUR_2,
            MasterLive.NEIGHBOUR_3,
        )
        wired = [[view.of_diagnosis(at, port) for port in ports] for at in (1001, 1002, 1004)]
        assert wired == [[0, 1002, 1004, 0], [1001, 1003, 0, 0], [1001, 0, 0, 0]]

    play(scene)


def test_view_reads_registers_once_for_all_clients_until_they_are_old() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        await asyncio.gather(*(view.refresh(DIAGNOSIS) for _ in range(9)))
        looks = len(engine.of(ExchangeDatagrams))
        await view.refresh(DIAGNOSIS)
        assert len(engine.of(ExchangeDatagrams)) == looks
        await elapse(FRESH_S)
        await view.refresh(LISTS)
        await view.refresh(CONFIGURED)  # links of the configuration
        assert len(engine.of(ExchangeDatagrams)) == looks
        await view.refresh(DIAGNOSIS)
        assert len(engine.of(ExchangeDatagrams)) > looks

    play(scene)


def test_view_scans_the_bus_after_a_write() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        await view.refresh(LISTS)
        view.write_master(MasterLive.DETECT_REQUEST, b"\1\0")
        view.write_master(MasterLive.DETECT_REQUEST, b"\1\0")
        assert view.of_master(MasterLive.DETECT_STATUS) == 255
        await eventually(lambda: view.of_master(MasterLive.DETECT_STATUS) == 1)
        assert view.of_master(MasterLive.DETECT_RESPONSE) == bytes((1, 0, 0, 0, 4, 0))
        assert view.of_detected(1001, MasterLive.ADDRESS) == 1001
        assert view.of_detected(1001, MasterLive.PRODUCT) == view.of_configured(
            1001, MasterLive.PRODUCT
        )

    play(scene)


def test_view_requests_states_and_sets_loops() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        await view.refresh(DIAGNOSIS)
        view.write_slave(1001, MasterLive.AL_CONTROL, 1)
        await eventually(lambda: bool(engine.of(BringSlaves)))
        assert engine.of(BringSlaves)[0].target == 1
        assert view.of_diagnosis(1001, MasterLive.AL_CONTROL) == 1
        for value in (0, 5, 99):
            with pytest.raises(SdoAbortError, match=f"{value:#x} is no AL state"):
                view.write_slave(1001, MasterLive.AL_CONTROL, value)
        view.write_slave(1004, MasterLive.LINK_CONTROL, 0x0C)
        await settle()
        await view.refresh(DIAGNOSIS)
        assert view.of_diagnosis(1004, MasterLive.LINK_CONTROL) == 0x0C
        view.write_slave(1004, MasterLive.FIXED_LINKS, 1)
        assert view.of_diagnosis(1004, MasterLive.FIXED_LINKS) is True
        view.write_slave(1004, MasterLive.FIXED_LINKS, 0)
        assert view.of_diagnosis(1004, MasterLive.FIXED_LINKS) is False

    play(scene)


def test_view_counts_frame_errors_from_a_reset_on() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        def total() -> int:
            ports = (MasterLive.CRC_0, MasterLive.CRC_1, MasterLive.CRC_2, MasterLive.CRC_3)
            return sum(view.of_diagnosis(at, port) for at in view.configured() for port in ports)

        engine.buses[0].line.fault(kind="corrupt", slave="inputs", every=3)
        await view.refresh(DIAGNOSIS)
        await elapse(FRESH_S)
        await view.refresh(DIAGNOSIS)
        view.write_master(MasterLive.RESET, b"\0")
        assert total() > 0, "only a rising edge resets"
        view.write_master(MasterLive.RESET, b"\1")
        assert total() == 0

    play(scene)


def test_view_counts_faults_of_slaves_from_a_reset_on() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        past = (MasterLive.ABSENCES, MasterLive.ABNORMAL_CHANGES, MasterLive.AL_STATUS_CODE)

        async def shown() -> list[int]:
            await elapse(FRESH_S)
            await view.refresh(DIAGNOSIS)
            return [view.of_diagnosis(1002, key) for key in past]

        report = engine.buses[0].report()

        def happens(**what: int) -> None:
            slaves = [
                msgspec.structs.replace(slave, **what) if slave.station == 1002 else slave
                for slave in report.slaves
            ]
            engine.buses[0].report = lambda: msgspec.structs.replace(report, slaves=tuple(slaves))

        happens(losses=2, departures=1, al_code=0x1B)
        assert await shown() == [2, 1, 0x1B]
        view.write_master(MasterLive.RESET, b"\1")
        assert await shown() == [0, 0, 0]
        happens(losses=2, departures=2, al_code=0x1E)
        assert await shown() == [0, 1, 0x1E]

    play(scene)


def test_view_reads_the_device_type_of_slaves_once() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        assert not view.is_fresh(CONFIGURED)
        await asyncio.gather(*(view.refresh(CONFIGURED) for _ in range(3)))
        assert view.of_configured(1001, MasterLive.DEVICE_TYPE) == 0x0002_0192
        assert view.of_configured(1001, MasterLive.TYPE) == "drive"
        asked = len(engine.of(ExchangeMailbox))
        await elapse(FRESH_S)
        await view.refresh(CONFIGURED)
        assert view.is_fresh(CONFIGURED)
        assert view.is_fresh(CONFIGURED + 9), "there is none that could be asked"
        assert len(engine.of(ExchangeMailbox)) == asked

    play(scene, "drive")


def test_view_of_a_bus_that_is_down_has_no_slaves() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        engine.buses[0].is_up = False
        await view.refresh(DIAGNOSIS)
        assert view.configured() == view.detected() == ()
        assert view.of_master(MasterLive.STATE) == 1

    play(scene)


class ScriptedClient:
    """A client of one bus with one slave, which answers its mailbox with *replies*."""

    on_change: list[Callable[[], None]]

    def __init__(self, *replies: str, slave: SlaveDescription = SLAVE) -> None:
        self.replies = list(replies)
        self.asked = 0
        self.is_current = True
        self.on_change = []
        self.view = self
        self.name = "left/bus0"
        self.show(msgspec.structs.replace(slave, to_slave=slave.to_slave or 64))

    def show(self, slave: SlaveDescription) -> None:
        self.latest = BusDescription(is_up=True, fault="", slaves={slave.station: slave})
        for notify in self.on_change:
            notify()

    async def current(self) -> BusDescription:
        return self.latest

    async def run(self, procedure: Any) -> dict[int, Any]:
        procedure.close()
        return {}

    async def converse(self, station: int, conversation: Any, *, requester: str) -> SlaveFacts:
        self.asked += 1
        if not self.replies:
            conversation.close()
            raise MailboxTimeoutError("no answer")
        next(conversation)
        try:
            for octets in self.replies:
                conversation.send(MailboxMessage(MailboxType.COE, bytes.fromhex(octets)))
        except StopIteration as end:
            found: SlaveFacts = end.value
            return found
        return await asyncio.sleep(9, SlaveFacts())


def facts_of(client: ScriptedClient, times: int = 1) -> tuple[int, bool]:
    """Return what the configuration of the slave shows of its own objects."""
    view = MasterView(client)  # type: ignore[arg-type]

    async def run() -> None:
        for _ in range(times):
            await view.refresh(CONFIGURED)
        assert view.is_fresh(CONFIGURED)

    run_virtual(run())
    return view.of_configured(1001, MasterLive.DEVICE_TYPE), view.of_configured(
        1001, MasterLive.HAS_HISTORY
    )


def test_slave_objects_are_read_once() -> None:
    client = ScriptedClient(TYPE, HISTORY)
    assert facts_of(client, times=2) == (0x0002_0192, True)
    assert client.asked == 1
    assert facts_of(ScriptedClient(TYPE, NO_HISTORY)) == (0x0002_0192, False)


def test_slave_objects_are_read_again_after_the_slave_was_gone() -> None:
    client = ScriptedClient(TYPE, HISTORY)
    view = MasterView(client)  # type: ignore[arg-type]
    slave = client.latest.slaves[1001]

    async def run() -> None:
        await view.refresh(CONFIGURED)
        client.show(msgspec.structs.replace(slave, state=0))
        assert view.of_configured(1001, MasterLive.DEVICE_TYPE) == 0
        client.show(slave)
        assert not view.is_fresh(CONFIGURED)
        await view.refresh(CONFIGURED)
        assert view.of_configured(1001, MasterLive.DEVICE_TYPE) == 0x0002_0192

    run_virtual(run())
    assert client.asked == 2


def test_slave_that_did_not_answer_is_not_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(master_values, "FACTS_ANSWER_S", 0.01)
    for client in (ScriptedClient(), ScriptedClient(TYPE)):
        assert facts_of(client, times=2) == (0, False)
        assert client.asked == 1


def test_slave_without_coe_is_not_read() -> None:
    client = ScriptedClient(slave=msgspec.structs.replace(SLAVE, protocols=0))
    assert facts_of(client) == (0, False)
    client.show(SLAVE)
    assert facts_of(client) == (0, False)
    assert client.asked == 0


def test_configured_values_are_those_of_slave_and_facts() -> None:
    facts = SlaveFacts(0x0002_0192, has_history=True)
    shown = {
        MasterLive.TYPE: "AX5000",
        MasterLive.NAME: "axis",
        MasterLive.DEVICE_TYPE: 0x0002_0192,
        MasterLive.MAILBOX_OUT: 256,
        MasterLive.MAILBOX_IN: 128,
        MasterLive.LINK_STATUS: 0,
        MasterLive.LINK_PRESET: 0x11,
        MasterLive.FLAGS: 0,
        MasterLive.PHYSICS: 0x31,
        MasterLive.HAS_HISTORY: True,
    }
    assert {key: configured_value(SLAVE, WIRED, facts, key) for key in shown} == shown


def test_configured_mailbox_that_is_open_has_its_own_size() -> None:
    slave = msgspec.structs.replace(SLAVE, to_slave=512, to_master=64, order="")
    keys = (MasterLive.MAILBOX_OUT, MasterLive.MAILBOX_IN, MasterLive.TYPE)
    values = [configured_value(slave, WIRED, SlaveFacts(), key) for key in keys]
    assert values == [512, 64, "axis"]


@pytest.mark.parametrize(
    ("dl", "expected"),
    [
        (WIRED, 0),
        (DlStatus(link=0b0001, communication0=1), 0x24),
        (DlStatus(link=0b0011, communication0=1), 0x22),
        (DlStatus(link=0b0111, communication0=1, communication1=1, communication2=1), 0x48),
        (DlStatus(link=0b1001, communication0=1, communication3=1), 0xAC),
    ],
)
def test_link_status_names_links_that_differ_from_the_first_scan(
    dl: DlStatus, expected: int
) -> None:
    assert link_status(SLAVE, dl) == expected


def test_link_status_of_a_slave_that_does_not_answer_is_no_link() -> None:
    assert link_status(msgspec.structs.replace(SLAVE, state=0), WIRED) == 1


def test_provider_serves_a_dictionary_that_is_fresh() -> None:
    async def run() -> None:
        engine = FakeEngine(FakeBus(LoopBus("drive")))
        link = EngineLink(engine.services)
        provider = MasterDictionaryProvider(BusClient(link, 0, PORT), "1.0")
        try:
            await provider.refresh(DIAGNOSIS)
            read = provider.dictionary.upload
            assert read(0x1008, 0, OdState.OP) == b"EtherCAT master left/bus0"
            assert read(0xF020, 1, OdState.OP) == b"\xe9\x03"
            assert read(0xA000, 1, OdState.OP) == b"\2\0"
            session = MasterSession(provider.dictionary, 1000, provider.refresh, provider.is_fresh)
            (reply,) = await session.handle(
                MailboxType.COE, bytes.fromhex("0020 40 0080 01 00000000")
            )
            assert reply.body.hex() == "0030" + "4b" + "0080" + "01" + "e9030000"
        finally:
            link.close()
            engine.close()

    run_virtual(run())
