"""Notifications of variables, from the samples that an engine keeps."""

from __future__ import annotations

import asyncio
import logging
from time import monotonic_ns

import pytest
from msgspec.structs import replace

from eap.ads.notifications import AdsClient, NotificationTable
from eap.codec.ads import IndexGroup as G
from eap.codec.adsnotification import AddNotification, TransMode, decode_notification, to_filetime
from eap.codec.ams import AmsCommand, decode_packet
from eap.ids import Endpoint, NetId
from eap.net.image_file import create_image
from eap.pd.image import ImageSamples, Inputs, Sampler
from eap.pd.layout import plan_layout
from eap.pd.spec import VariableSpec, Writer
from eap.pd.words import StationWord
from eap.services.ads.station_symbols import NotificationPump, StationSymbols
from tests.support.eventually import eventually
from tests.support.virtualtime import run_virtual

MS = 1_000_000
CYCLE = 10 * MS
NET_ID, PORT = NetId.parse("1.2.3.4.5.1"), 0xFFFF
WAY = Endpoint("ams-tcp", "127.0.0.1:5 #1")
CLIENT = AdsClient(WAY, NetId.parse("1.2.3.4.1.1"), 30000)
UNIX_AT_0 = 1_700_000_000 * 10**9


class Engine:
    """Counts in the variable *ticks*, a cycle every 10 ms."""

    def __init__(self, file) -> None:
        self.attach(file)

    def attach(self, file) -> None:
        self.image = file.image
        self.sampler = Sampler(file.image, Inputs(file.image).memory)

    def run(self, cycles: int = 1) -> None:
        words = self.image.words
        for _ in range(cycles):
            words[StationWord.CYCLE] += 1
            words[StationWord.CYCLE_AT_NS] += CYCLE
            with self.image.writing(Writer.ENGINE):
                self.image.write("ticks", words[StationWord.CYCLE])
            self.sampler.end_cycle(words[StationWord.CYCLE], words[StationWord.CYCLE_AT_NS] + 7)

    @property
    def now_ns(self) -> int:
        return self.image.words[StationWord.CYCLE_AT_NS] + MS


class Bench:
    """A table whose notifications are driven, and what its client got."""

    def __init__(self, engine, station) -> None:
        self.engine = engine
        self.sent: list[tuple[Endpoint, bytes]] = []
        self.symbols = StationSymbols(station)
        self.table = NotificationTable()
        self.pump = NotificationPump(self.symbols, lambda *packet: self.sent.append(packet))
        self.pump.add(self.table, NET_ID, PORT)

    def watch(self, name: str, mode=TransMode.SERVER_CYCLE, cycle_ns=0, delay_ns=0, size=2) -> int:
        handle = self.symbols.read_write(G.SYMBOL_HANDLE, 0, 4, name.encode())
        number = int.from_bytes(handle, "little")
        source = self.symbols.watch(G.VALUE_BY_HANDLE, number, size)
        asked = AddNotification(
            G.VALUE_BY_HANDLE, number, size, mode, delay_ns // 100, cycle_ns // 100
        )
        return self.table.add(CLIENT, asked, source, self.engine.now_ns)

    def refresh(self) -> int | None:
        return self.pump.advance(self.engine.now_ns, self.engine.now_ns + UNIX_AT_0)

    def told(self) -> list[tuple[int, int]]:
        """Return time in cycles and value of all samples since the last call."""
        found = []
        for endpoint, packet in self.sent:
            header, body = decode_packet(packet)
            assert (endpoint, header.target, header.target_port) == CLIENT
            assert (header.source, header.source_port) == (NET_ID, PORT)
            assert header.command == AmsCommand.NOTIFICATION
            for stamp in decode_notification(body):
                cycle, rest = divmod((stamp.time - to_filetime(UNIX_AT_0)) * 100, CYCLE)
                assert rest == 0
                found += [(cycle, int.from_bytes(each.data, "little")) for each in stamp.samples]
        self.sent.clear()
        return found


@pytest.fixture
def engine(files):
    return Engine(files["left"])


@pytest.fixture
def bench(engine, images):
    return Bench(engine, images["left"])


def test_pump_without_notifications_does_not_poll(bench):
    bench.engine.run(3)
    assert bench.refresh() is None
    assert bench.engine.image.words[StationWord.SAMPLED_UNTIL] == 0


def test_pump_sends_each_cycle_with_its_time(bench):
    bench.watch("ticks")
    bench.refresh()
    bench.engine.run(5)
    bench.refresh()
    assert bench.told() == [(n, n) for n in range(1, 6)]
    bench.engine.run()
    bench.refresh()
    assert bench.told() == [(6, 6)]


def test_pump_sends_as_many_cycles_as_are_kept(bench):
    bench.watch("ticks")
    bench.refresh()
    count = bench.engine.image.layout.samples.count
    bench.engine.run(count + 2)
    bench.refresh()
    assert bench.told() == [(n, n) for n in range(3, count + 3)]


def test_pump_yields_between_many_values(bench):
    for _ in range(300):
        bench.watch("ticks")
    bench.refresh()
    bench.engine.run(5)
    assert bench.refresh() == MS
    assert {cycle for cycle, _ in bench.told()} == {1, 2}
    assert bench.refresh() == MS
    assert bench.refresh() > MS
    assert {cycle for cycle, _ in bench.told()} == {3, 4, 5}


def test_pump_sends_and_polls_only_due_notifications(bench):
    bench.engine.run()
    bench.watch("ticks", cycle_ns=5 * CYCLE)
    assert bench.refresh() == CYCLE + 200_000 - MS
    bench.engine.run()
    delay_ns = bench.refresh()
    assert bench.told() == [(2, 2)]
    assert 3 * CYCLE < delay_ns <= 5 * CYCLE
    bench.engine.run(10)
    bench.refresh()
    assert bench.told() == [(6, 6), (11, 11)]


def test_pump_sends_changes(bench, images):
    bench.watch("running", TransMode.SERVER_ON_CHANGE, size=1)
    bench.refresh()
    for _ in range(3):
        bench.engine.run(2)
        bench.refresh()
    assert bench.told() == [(1, 0)]


def test_pump_stops_polling_after_the_last_notification(bench):
    handle = bench.watch("ticks")
    bench.refresh()
    bench.table.delete(CLIENT, handle)
    assert bench.refresh() is None


def test_pump_sends_nothing_to_a_closed_connection(bench):
    bench.watch("ticks")
    bench.refresh()
    bench.table.forget(WAY)
    bench.engine.run(2)
    assert bench.refresh() is None
    assert bench.told() == []


def test_pump_polls_a_stopped_engine_less_often(bench):
    bench.watch("ticks")
    bench.refresh()
    now_ns = bench.engine.now_ns
    assert bench.pump.advance(now_ns + 2 * CYCLE, now_ns) == MS
    assert bench.pump.advance(now_ns + 9 * CYCLE, now_ns) == 10 * MS
    bench.engine.run(2)  # as if by another one
    bench.refresh()
    assert bench.told() == [(1, 1), (2, 2)]


def test_pump_requests_samples_for_a_second(bench):
    bench.watch("ticks", cycle_ns=10**12)
    bench.refresh()
    bench.engine.run(7)
    assert bench.refresh() == 200 * MS
    assert bench.engine.image.words[StationWord.SAMPLED_UNTIL] == 7 + 102


def test_new_layout_is_followed(bench, stations, files):
    bench.watch("ticks")
    bench.refresh()
    bench.engine.run()
    bench.refresh()
    spec = replace(stations[0], variables=(*stations[0].variables, VariableSpec("more", "UDINT")))
    with create_image(files["left"].path, plan_layout(spec)) as fresh:
        bench.engine.attach(fresh)
        bench.refresh()
        bench.engine.run(2)
        bench.refresh()
        assert bench.told() == [(1, 1), (2, 2), (3, 3)]


def test_notification_of_a_removed_variable_ends(bench, stations, files):
    bench.watch("ticks")
    bench.refresh()
    spec = replace(stations[0], variables=stations[0].variables[1:], sources=(), frames=())
    with create_image(files["left"].path, plan_layout(spec)) as fresh:
        bench.engine.attach(fresh)
        bench.refresh()
        for cycle in (1, 2):
            fresh.image.words[StationWord.CYCLE] = cycle
            bench.engine.sampler.end_cycle(cycle, cycle * CYCLE)
        assert bench.refresh() == 0
        assert bench.refresh() is None
    ((_, packet),) = bench.sent
    ((sample,),) = [stamp.samples for stamp in decode_notification(decode_packet(packet)[1])]
    assert sample.data == b""


def test_sample_that_is_overwritten_while_it_is_read_is_missed(bench, monkeypatch):
    bench.watch("ticks")
    bench.refresh()
    bench.engine.run(3)
    read = ImageSamples.read
    monkeypatch.setattr(ImageSamples, "read", lambda self, n: None if n == 2 else read(self, n))
    bench.refresh()
    assert bench.told() == [(1, 1), (3, 3)]


def test_image_that_is_gone_is_waited_for(bench, files, stations):
    bench.watch("ticks")
    bench.refresh()
    files["left"].path.unlink()
    files["left"].retire()
    assert bench.refresh() == 200 * MS
    with create_image(files["left"].path, plan_layout(stations[0])) as fresh:
        bench.engine.attach(fresh)
        fresh.image.words[StationWord.CYCLE_AT_NS] = bench.engine.now_ns
        assert bench.refresh() is not None


def test_pump_sends_soon_to_a_new_client(bench):
    async def run():
        serving = asyncio.ensure_future(bench.pump.serve())
        await asyncio.sleep(0)
        bench.engine.image.words[StationWord.CYCLE_AT_NS] = monotonic_ns()
        bench.watch("ticks")
        await asyncio.sleep(0)
        bench.engine.run()
        await eventually(lambda: bench.sent)
        serving.cancel()

    run_virtual(run())


def test_pump_logs_a_fault_and_goes_on(bench, caplog, monkeypatch):
    caplog.set_level(logging.ERROR)
    bench.watch("ticks")
    monkeypatch.setattr(bench.symbols, "refresh", lambda: 1 // 0)

    async def run():
        serving = asyncio.ensure_future(bench.pump.serve())
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert not serving.done()
        serving.cancel()

    run_virtual(run())
    assert "notifications of station left" in caplog.text
