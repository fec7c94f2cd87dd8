"""ADS at the NetID of an EAP port."""

from __future__ import annotations

import asyncio
import struct

import pytest

from eap.ads.notifications import AdsClient
from eap.codec.ads import AdsDeviceInfo, AdsError, AdsState
from eap.codec.ads import IndexGroup as G
from eap.codec.ams import DEVICE_PORT, AmsAnswer, AmsCommand, AmsHeader
from eap.errors import EngineRefusedError
from eap.ids import Endpoint, NetId
from eap.od.profiles.eap1000 import Tx
from eap.pd.device import DeviceState, FaultCode
from eap.pd.words import StationWord
from eap.services.ads.ads_service import device_info
from eap.services.ads.station_ads import EapAds
from eap.services.ads.station_symbols import StationSymbols
from eap.services.routing.service import LocalRequest
from eap.services.tasks import MAX_WAITING
from tests.support import aoe
from tests.support.stationengine import make_device
from tests.support.virtualtime import run_virtual

TXPD, CONTROL = 0xD000, 0xF200
OK = bytes(4)
CLIENT = AdsClient(Endpoint("ams-tcp", "1"), NetId.parse("1.2.3.4.1.1"), 30000)
TARGET = NetId.parse("1.2.3.4.5.1")
INFO = device_info("left/eap0", "1.2.3")


class Bench:
    """A port of a station and the engine that it asks."""

    def __init__(self, spec, image) -> None:
        self.device, self.engine = make_device(spec)
        self.ads = EapAds(self.device, "eap0", StationSymbols(image), INFO)

    async def ask(self, command, body=b""):
        header = AmsHeader(TARGET, DEVICE_PORT, CLIENT.net_id, CLIENT.port, command)
        answer = self.ads.answer(LocalRequest(header, body, CLIENT.endpoint))
        return answer if isinstance(answer, AmsAnswer) else await answer

    async def read(self, offset, group=G.SDO):
        return await self.ask(AmsCommand.READ, aoe.read_body(offset, group=group))

    async def write(self, offset, data, group=G.SDO):
        return await self.ask(AmsCommand.WRITE, aoe.write_body(offset, data, group))

    async def control(self, ads_state):
        return await self.ask(AmsCommand.WRITE_CONTROL, struct.pack("<HHI", ads_state, 0, 0))

    async def state(self):
        return struct.unpack("<IHH", (await self.ask(AmsCommand.READ_STATE)).data)

    def run(self, script):
        return run_virtual(script())


@pytest.fixture
def bench(stations, images):
    return Bench(stations[0], images["left"])


def result(answer):
    assert not answer.error_code
    return int.from_bytes(answer.data[:4], "little")


@pytest.mark.parametrize(
    ("release", "numbers"), [("1.2.3", (1, 2, 3)), ("0.4", (0, 4, 0)), ("2.1rc1.7.9", (2, 0, 7))]
)
def test_device_info_of_an_eap_port(release, numbers):
    name = b"island-01/eap0".ljust(16, b"\0")
    assert device_info("island-01/eap0", release) == AdsDeviceInfo(*numbers, name)


def test_reads_are_at_hand_unless_something_speaks_against_them(bench):
    def now(command, body):
        packet = aoe.packet("1.1.1.1.2.1", command, body)
        return bench.ads.answer_now(AmsHeader.decode(packet), body)

    body = aoe.read_body(0x10000000, 4)
    assert now(AmsCommand.READ, body).data == OK + struct.pack("<II", 4, 1000 << 16 | 5001)
    assert now(AmsCommand.READ, body[:-1]) is None
    assert now(AmsCommand.READ, aoe.read_body(0x20000000)) is None
    assert now(AmsCommand.READ, aoe.read_body(0x10000000, 3)) is None
    assert now(AmsCommand.READ_STATE, b"") is None
    assert now(AmsCommand.WRITE, aoe.write_body(0x10000000, b"1234")) is None


def test_its_dictionary_is_read_and_written(bench):
    async def script():
        info = await bench.ask(AmsCommand.READ_DEVICE_INFO)
        assert info.data == OK + INFO.encode()
        assert (await bench.read(TXPD << 16 | Tx.PD_ID)).data == OK + b"\2\0\0\0" + b"\7\0"
        refused = await bench.write(TXPD << 16 | Tx.PD_ID, b"\1\0")
        assert result(refused) == AdsError.STATE
        assert "0xD000:03" in refused.why
        assert "0x08000022" in refused.why
        for state in (b"\2\0", b"\x08\0"):
            assert result(await bench.write(CONTROL << 16 | 1, state)) == 0
            assert bench.engine.state == state[0]
        both = aoe.write_body(TXPD << 16 | Tx.PD_ID, b"")
        asked = struct.pack("<II", G.SDO, TXPD << 16 | Tx.PD_ID) + struct.pack("<II", 2, 0)
        assert (await bench.ask(AmsCommand.READ_WRITE, asked)).data[8:] == b"\7\0"
        assert result(await bench.ask(AmsCommand.WRITE, both)) == AdsError.STATE

    bench.run(script)


def test_missing_objects_are_refused_with_their_abort_code(bench):
    async def script():
        refused = await bench.read(0x2000_0000)
        assert result(refused) == AdsError.NOT_FOUND
        assert refused.why == "0x2000:00: object does not exist (0x06020000)"
        assert result(await bench.read(0, group=0x1234)) == AdsError.INDEX_GROUP
        raw = struct.pack("<4I", G.RAW_COMMAND, 0, 16, 16) + bytes(16)
        assert result(await bench.ask(AmsCommand.READ_WRITE, raw)) == AdsError.TIMEOUT

    bench.run(script)


def test_write_control_reports_an_error_of_the_engine(bench):
    async def script():
        await bench.write(CONTROL << 16 | 1, b"\4\0")
        bench.engine.failure = EngineRefusedError("no memory")
        refused = await bench.write(CONTROL << 16 | 1, b"\x08\0")
        assert result(refused) == AdsError.STATE
        assert "no memory" in refused.why

    bench.run(script)


def test_states_are_those_of_the_device(bench):
    async def script():
        assert await bench.state() == (0, AdsState.RUN, 8)
        assert result(await bench.control(AdsState.CONFIG)) == 0
        assert await bench.state() == (0, AdsState.CONFIG, 2)
        assert bench.engine.state is DeviceState.PREOP
        assert result(await bench.control(AdsState.RUN)) == 0
        refused = await bench.control(AdsState.INIT)
        assert result(refused) == AdsError.STATE
        assert refused.why
        assert result(await bench.control(AdsState.SHUTDOWN)) == AdsError.VALUE

    bench.run(script)
    assert bench.device.status.fault.code == FaultCode.INVALID_REQUEST


def test_items_of_a_sum_command_are_done_one_by_one(bench):
    writes = struct.pack("<6I", G.SDO, CONTROL << 16 | 1, 2, G.SDO, 0x1234_0000, 2)
    body = struct.pack("<4I", G.SUM_WRITE, 2, 8, len(writes) + 4) + writes + b"\2\0" + b"\0\0"

    async def script():
        done = await bench.ask(AmsCommand.READ_WRITE, body)
        assert done.data[8:] == OK + b"\x0c\7\0\0"

    bench.run(script)
    assert bench.engine.state is DeviceState.PREOP


def test_variables_are_read_and_written_by_name(bench, files):
    async def script():
        name = b"running\0"
        asked = struct.pack("<4I", G.SYMBOL_HANDLE, 0, 4, len(name)) + name
        handle = int.from_bytes((await bench.ask(AmsCommand.READ_WRITE, asked)).data[8:], "little")
        assert result(await bench.write(handle, b"\1", group=G.VALUE_BY_HANDLE)) == 0
        assert (await bench.read(handle, group=G.VALUE_BY_HANDLE)).data[8:] == b"\1"

    bench.run(script)
    assert files["left"].image.read("running") is True


def test_writer_in_the_middle_is_waited_for(bench, files):
    words = files["left"].image.words

    async def script():
        asked = struct.pack("<4I", G.VALUE_BY_NAME, 0, 1, 7) + b"running"
        words[StationWord.APPLICATION_SEQUENCE] += 1
        asyncio.get_running_loop().call_later(0.02, finish)
        assert result(await bench.ask(AmsCommand.READ_WRITE, asked)) == 0
        words[StationWord.APPLICATION_SEQUENCE] += 1
        stopped = await bench.ask(AmsCommand.READ_WRITE, asked)
        assert result(stopped) == AdsError.BUSY
        assert "stopped in the middle" in stopped.why

    def finish():
        words[StationWord.APPLICATION_SEQUENCE] += 1

    bench.run(script)


def test_crowd_of_changes_is_busy(bench):
    async def script():
        bench.engine.gate = asyncio.Event()
        changes = [asyncio.ensure_future(bench.control(AdsState.CONFIG))]
        await bench.engine.asked.wait()
        changes += [
            asyncio.ensure_future(bench.control(AdsState.CONFIG)) for _ in range(MAX_WAITING)
        ]
        await asyncio.sleep(0)
        crowded = [await bench.control(AdsState.RUN), await bench.write(CONTROL << 16 | 1, b"\2\0")]
        assert [result(each) for each in crowded] == [AdsError.BUSY] * 2
        assert all("wait already" in each.why for each in crowded)
        bench.engine.gate.set()
        await asyncio.gather(*changes)

    bench.run(script)
