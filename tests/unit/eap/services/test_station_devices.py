"""The devices of an appliance, built from a handover."""

from __future__ import annotations

import asyncio
from time import monotonic_ns

import pytest
from msgspec.structs import replace

from eap.codec.ams import AmsCommand
from eap.errors import EngineGoneError
from eap.ids import NetId
from eap.net.image_file import create_image
from eap.pd.device import DeviceState
from eap.pd.layout import plan_layout
from eap.pd.spec import HostSource, Measure, VariableSpec
from eap.pd.words import StationWord
from eap.services.process import StationDevices
from tests.support import aoe
from tests.support.eventually import eventually
from tests.support.stationengine import StationEngine
from tests.support.virtualtime import run_virtual


@pytest.fixture
def engine(stations):
    return StationEngine(stations[0])


@pytest.fixture
def devices(stations, images, engine):
    states = {"right": DeviceState.PREOP}
    return StationDevices("demo", stations, states, images, engine, "1.2")


def play(devices, script):
    async def run():
        serving = asyncio.ensure_future(devices.serve())
        try:
            await script()
        finally:
            serving.cancel()

    run_virtual(run())


def test_each_device_has_its_state_and_identity(devices):
    assert {name: each.status.state for name, each in devices.by_station.items()} == {
        "left": DeviceState.OP,
        "right": DeviceState.PREOP,
    }
    left = devices.by_station["left"]
    assert left.upload("eap0", 0x1008, 0) == b"EAP station left"
    assert left.upload("eap0", 0x100A, 0) == b"1.2"


def test_live_values_are_those_of_the_image(devices, files):
    files["left"].image.words[0] = 77
    assert devices.by_station["left"].upload("eap0", 0xF110, 1) == (77).to_bytes(8, "little")


def test_port_answers_by_its_net_id_and_the_router_by_its_own(devices, stations):
    left = devices.routers["left"]
    asked = [
        (stations[0].ports[0].net_id, 0xFFFF, AmsCommand.READ, aoe.read_body(0x1000 << 16)),
        (stations[0].net_id, 10_000, AmsCommand.READ_STATE, b""),
        (stations[0].net_id, 851, AmsCommand.READ_STATE, b""),
        (NetId.parse("9.9.9.9.9.9"), 0xFFFF, AmsCommand.READ_STATE, b""),
    ]
    answers = []

    async def script():
        for net_id, *more in asked:
            answers.append(await left.request(net_id, *more, timeout_s=1))

    play(devices, script)
    assert [each.error_code for each in answers] == [0, 0, 6, 7]
    assert answers[0].data[8:] == bytes.fromhex("8913e803")
    assert answers[1].data == bytes.fromhex("00000000 0500 0800")


def test_sources_follow_the_configuration(devices, files, stations):
    spec = replace(stations[0], sources=(HostSource("load", Measure.PROCESSES, period_ms=10),))

    async def script():
        await devices.by_station["left"].apply(spec)
        await eventually(lambda: files["left"].image.read("load"))

    play(devices, script)


def test_restarted_engine_is_synchronized(images, engine, stations):
    devices = StationDevices("demo", stations[:1], {}, images, engine, "1.2")

    async def script():
        engine.failure = EngineGoneError("gone")
        _, fault = await devices.by_station["left"].apply(replace(stations[0], cycle_us=20_000))
        assert fault is not None
        engine.asked.clear()
        devices.engine_has_restarted()
        await asyncio.wait_for(engine.asked.wait(), 5)

    play(devices, script)
    assert engine.calls.count("configure left") == 2


def test_running_engine_is_synchronized(stations, images, files, engine):
    files["left"].image.words[StationWord.CYCLE_AT_NS] = monotonic_ns()
    spec = replace(stations[0], cycle_us=20_000)
    states = {"left": DeviceState.SAFEOP}
    devices = StationDevices("demo", (spec,), states, images, engine, "1.2")

    async def script():
        await eventually(lambda: engine.state is DeviceState.SAFEOP)

    play(devices, script)
    assert engine.spec == spec
    assert engine.calls == ["configure left", "left SAFEOP"]


def test_image_that_a_dead_engine_did_not_retire_is_left(devices, files, stations, tmp_path):
    spec = replace(stations[0], variables=(*stations[0].variables, VariableSpec("more", "UINT")))
    with create_image(tmp_path / "fresh.image", plan_layout(spec)) as fresh:
        fresh.image.words[StationWord.CYCLE] = 9
        fresh.path.replace(files["left"].path)
        left = devices.by_station["left"]
        assert left.upload("eap0", 0xF110, 1) == bytes(8)

        async def script():
            devices.engine_has_restarted()
            await eventually(lambda: left.upload("eap0", 0xF110, 1) != bytes(8))

        play(devices, script)
