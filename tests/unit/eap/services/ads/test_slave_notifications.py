"""Notifications on values of slaves: shared sampling, limits, errors and ends."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from time import monotonic_ns

import pytest

from eap.ads.notifications import AdsClient
from eap.ads.request import AdsRefusedError, DeleteNotification, Read, WriteControl
from eap.codec.ads import AdsError, AdsState, IndexGroup
from eap.codec.adsnotification import AddNotification, TransMode, decode_notification
from eap.codec.ams import AmsHeader
from eap.errors import EapError
from eap.ids import Endpoint, NetId
from eap.runtime.engine_messages import ExchangeMailbox
from eap.services.ads import slave_notifications
from eap.services.ads.slave_notifications import Pace, SamplingBudget, SlaveNotifications
from tests.support.busads import DRIVE, Client, play, until
from tests.support.virtualtime import run_virtual

BUS = NetId.parse("5.1.1.1.3.1")
ME = AdsClient(Endpoint("tcp", "1"), NetId(b"client"), 30000)
YOU = ME._replace(endpoint=Endpoint("tcp", "2"))
UNIT = 10_000
"""Units of a request in a millisecond."""
WINDOW = 0x6065_0000
TALKER = 1001


def asked(
    offset: int = WINDOW,
    length: int = 4,
    mode: int = TransMode.SERVER_CYCLE,
    *,
    cycle_ms: int = 20,
    group: int = IndexGroup.SDO,
) -> AddNotification:
    return AddNotification(group, offset, length, mode, 0, cycle_ms * UNIT)


def samples(told: list[tuple[Endpoint, bytes]], endpoint: Endpoint) -> list[tuple[int, bytes]]:
    """Return handles and values that went to an endpoint."""
    found = []
    for to, packet in told:
        if to == endpoint:
            for stamp in decode_notification(packet[AmsHeader.SIZE :]):
                found += [(sample.handle, sample.data) for sample in stamp.samples]
    return found


async def handle_of(client: Client, request: AddNotification, port: int = DRIVE) -> int:
    return int.from_bytes(await client.good(port, request), "little")


def test_object_is_sampled_cyclically_from_the_address_of_the_slave():
    async def scene(client, engine):
        handle = await handle_of(client, asked())

        async def has_three():
            return len(samples(client.told, client.endpoint)) >= 3

        await until(has_three)
        header = AmsHeader.decode(client.told[0][1])
        assert (header.source, header.source_port) == (BUS, DRIVE)
        value = await client.read(DRIVE, IndexGroup.SDO, WINDOW)
        assert set(samples(client.told, client.endpoint)) == {(handle, value)}

    play(scene)


def test_value_on_change_is_sent_at_first_and_when_it_changes():
    async def scene(client, engine):
        handle = await handle_of(client, asked(mode=TransMode.SERVER_ON_CHANGE))

        async def told(count):
            return len(samples(client.told, client.endpoint)) >= count

        await until(lambda: told(1))
        await client.write(DRIVE, IndexGroup.SDO, WINDOW, b"\x11\x22\0\0")
        await until(lambda: told(2))
        await asyncio.sleep(0.1)
        first, *others = samples(client.told, client.endpoint)
        assert first[0] == handle
        assert others == [(handle, b"\x11\x22\0\0")]

    play(scene)


def test_sum_commands_add_and_delete_notifications():
    async def scene(client, engine):
        requests = b"".join(asked(offset).encode() for offset in (WINDOW, 0x5555_0000))
        added = await client.ask(DRIVE, IndexGroup.SUM_ADD_NOTIFICATION, 2, requests, 16)
        results = [int.from_bytes(added[at : at + 4], "little") for at in (0, 8)]
        assert results == [0, AdsError.NOT_FOUND]
        handle = added[4:8]
        gone = await client.ask(DRIVE, IndexGroup.SUM_DELETE_NOTIFICATION, 2, 2 * handle, 8)
        assert gone == bytes(4) + AdsError.NOTIFICATION_HANDLE.to_bytes(4, "little")

    play(scene)


def test_deleted_notification_and_gone_client_get_no_more_samples():
    async def scene(client, engine):
        handle = await handle_of(client, asked())
        other = Client(client.service, client.bus, client.told)
        other.endpoint = Endpoint("ams-tcp", "2")
        with pytest.raises(AssertionError, match="NOTIFICATION_HANDLE"):
            await other.good(DRIVE, DeleteNotification(handle))
        await handle_of(other, asked())
        await client.good(DRIVE, DeleteNotification(handle))
        client.service.client_gone(other.endpoint)
        engine.requests.clear()
        client.told.clear()
        await asyncio.sleep(0.2)
        assert (client.told, engine.requests) == ([], [])
        gone = await client.do(DRIVE, DeleteNotification(handle))
        assert gone.result == AdsError.NOTIFICATION_HANDLE

    play(scene)


@pytest.mark.parametrize(
    ("request_", "result"),
    [
        (asked(0x5555_0000), AdsError.NOT_FOUND),
        (asked(length=2), AdsError.SIZE),
        (asked(length=8), AdsError.SIZE),
        (asked(length=0), AdsError.WATCH_SIZE),
        (asked(mode=TransMode.CLIENT_CYCLE), AdsError.TRANS_MODE),
        (asked(group=IndexGroup.VOE), AdsError.SERVICE),
        (asked(group=IndexGroup.FOE_READ), AdsError.SERVICE),
    ],
)
def test_notification_that_cannot_be_is_refused_at_once(request_, result):
    async def scene(client, engine):
        assert (await client.do(DRIVE, request_)).result == result
        engine.requests.clear()
        await asyncio.sleep(0.05)
        assert not engine.requests

    play(scene)


def test_other_values_of_slaves_are_sampled():
    async def scene(client, engine):
        idn = await handle_of(client, asked(0x40 << 16 | 32, group=IndexGroup.SOE))
        state = await handle_of(client, asked(0, group=IndexGroup.DEVICE_DATA))

        async def has_both():
            return {handle for handle, _ in samples(client.told, client.endpoint)} == {idn, state}

        await until(has_both)

    play(scene)


def test_aoe_serves_values_of_slaves_without_coe():
    async def scene(client, engine):
        handle = await handle_of(client, asked(0x8002_0000), TALKER)

        async def is_told():
            return (handle, b"\7\0\0\0") in samples(client.told, client.endpoint)

        await until(is_told)

    play(scene, "aoe")


def test_notification_outlives_a_state_without_mailbox():
    async def scene(client, engine):
        handle = await handle_of(client, asked())
        await client.good(DRIVE, WriteControl(AdsState.INIT, 0, b""))
        await until(lambda: is_silent(client))
        await client.good(DRIVE, WriteControl(AdsState.CONFIG, 0, b""))

        async def is_told():
            return bool(samples(client.told, client.endpoint))

        await until(is_told)
        assert all(data for _, data in samples(client.told, client.endpoint))
        await client.good(DRIVE, DeleteNotification(handle))

    play(scene)


async def is_silent(client: Client) -> bool:
    client.told.clear()
    await asyncio.sleep(0.1)
    return not client.told


class Line:
    """Slaves without mailboxes, whose values and errors a test sets."""

    def __init__(self) -> None:
        self.data = b"\1\0"
        self.error: EapError | None = None
        self.reads: list[int] = []
        self.told: list[tuple[Endpoint, bytes]] = []
        self.gate = asyncio.Event()
        self.gate.set()
        self.budget = SamplingBudget()
        self.notifications = SlaveNotifications(
            BUS,
            self.read,
            lambda endpoint, packet: self.told.append((endpoint, packet)),
            self.budget,
            lambda station: f"left/bus0/{station}",
        )

    async def read(self, station: int, place: Read) -> bytes:
        await self.gate.wait()
        self.reads.append(monotonic_ns())
        if self.error is not None:
            raise self.error
        return self.data

    async def add(self, client: AdsClient = ME, offset: int = 0, **how: int) -> int:
        return await self.notifications.add(1001, client, asked(offset, 2, **how))

    async def wait_samples(self, count: int, client: AdsClient = ME) -> list[tuple[int, bytes]]:
        await wait(lambda: len(samples(self.told, client.endpoint)) >= count)
        return samples(self.told, client.endpoint)


async def wait(condition: Callable[[], bool]) -> None:
    async def is_met() -> bool:
        return condition()

    await until(is_met)


def on_line(scene) -> None:
    async def run() -> None:
        async with asyncio.timeout(20):
            await scene(Line())

    run_virtual(run())


def test_clients_share_the_readings_of_a_value():
    async def scene(line):
        first = await line.add(cycle_ms=50)
        second = await line.add(YOU, cycle_ms=50)
        assert first != second
        await line.wait_samples(10)
        await line.wait_samples(10, YOU)
        mine, yours = (len(samples(line.told, each.endpoint)) for each in (ME, YOU))
        # One reading when it was added, then one for both; each of them for one sample of both.
        assert len(line.reads) <= max(mine, yours) + 3
        assert abs(mine - yours) <= 3

    on_line(scene)


def test_slow_notification_does_not_get_the_readings_of_a_fast_one():
    async def scene(line):
        slow = await line.add(cycle_ms=400)
        await line.add(YOU, cycle_ms=20)
        await line.wait_samples(40, YOU)
        got = [handle for handle, _ in samples(line.told, ME.endpoint)]
        assert 1 <= len(got) <= 4
        assert set(got) == {slow}

    on_line(scene)


def test_refusal_ends_a_notification_with_an_empty_sample(caplog):
    async def scene(line):
        handle = await line.add()
        await line.wait_samples(1)
        line.error = AdsRefusedError(AdsError.NOT_FOUND, "no such object")
        await wait(lambda: (handle, b"") in samples(line.told, ME.endpoint))
        reads = len(line.reads)
        await asyncio.sleep(0.1)
        assert len(line.reads) == reads
        assert "left/bus0/1001: 1 notification ended of object 0x0000:00: no such" in caplog.text
        assert caplog.text.count("no such object") == 1
        with pytest.raises(AdsRefusedError):
            line.notifications.delete(1001, ME, handle)

    on_line(scene)


def test_value_of_another_size_ends_a_notification():
    async def scene(line):
        handle = await line.add()
        line.data = b"\1\0\0"
        assert (await line.wait_samples(1))[0] == (handle, b"")

    on_line(scene)


def test_silent_slave_gets_few_readings_and_ends_its_notifications(monkeypatch, caplog):
    monkeypatch.setattr(slave_notifications, "RETRY_NS", 50_000_000)
    monkeypatch.setattr(slave_notifications, "GIVE_UP_S", 0.4)

    async def scene(line):
        handle = await line.add()
        await line.wait_samples(1)
        line.error = AdsRefusedError(AdsError.TIMEOUT, "slave 1001 does not answer")
        count = len(line.reads)
        await wait(lambda: samples(line.told, ME.endpoint)[-1] == (handle, b""))
        assert 2 <= len(line.reads) - count <= 12
        assert "left/bus0/1001: notifications without samples of object 0x0000:00" in caplog.text

    on_line(scene)


def test_notification_goes_on_after_a_short_silence(monkeypatch):
    monkeypatch.setattr(slave_notifications, "RETRY_NS", 20_000_000)

    async def scene(line):
        await line.add()
        await line.wait_samples(1)
        line.error = AdsRefusedError(AdsError.BUSY)
        count = len(line.reads)
        await wait(lambda: len(line.reads) >= count + 3)
        line.data, line.error = b"\2\0", None
        await wait(lambda: samples(line.told, ME.endpoint)[-1][1] == b"\2\0")
        assert all(data for _, data in samples(line.told, ME.endpoint))

    on_line(scene)


def test_client_that_leaves_during_the_first_reading_has_no_notification():
    async def scene(line):
        line.gate.clear()
        adding = asyncio.ensure_future(line.add())
        await asyncio.sleep(0)
        line.notifications.client_gone(ME.endpoint)
        line.gate.set()
        with pytest.raises(AdsRefusedError, match="disconnected"):
            await adding
        line.reads.clear()
        await asyncio.sleep(0.15)
        assert not line.reads

    on_line(scene)


def test_numbers_are_limited_and_given_back(monkeypatch):
    monkeypatch.setattr(slave_notifications, "CLIENT_NOTIFICATIONS", 2)
    monkeypatch.setattr(slave_notifications, "ALL_NOTIFICATIONS", 3)
    monkeypatch.setattr(slave_notifications, "SLAVE_VALUES", 2)

    async def scene(line):
        first = await line.add(offset=1)
        await line.add(offset=2)
        with pytest.raises(AdsRefusedError, match="2 notifications on values of slaves for this"):
            await line.add(offset=1)
        with pytest.raises(AdsRefusedError, match="2 values of slave 1001"):
            await line.add(YOU, offset=3)
        await line.add(YOU, offset=1)
        with pytest.raises(AdsRefusedError, match=r"3 notifications on values of slaves$"):
            await line.add(YOU, offset=1)
        line.notifications.delete(1001, ME, first)
        await line.add(offset=1)
        line.notifications.client_gone(ME.endpoint)
        line.notifications.client_gone(YOU.endpoint)
        await line.add(offset=4)
        await line.add(offset=5)

    on_line(scene)


def test_readings_of_a_slave_have_a_rate_limit(monkeypatch):
    async def scene(line):
        for offset in range(10):  # 50 readings a second each
            await line.add(offset=offset)
        line.reads.clear()
        start_ns = monotonic_ns()
        await wait(lambda: len(line.reads) >= 20)
        assert monotonic_ns() - start_ns >= 19 * 1_000_000_000 // slave_notifications.SLAVE_READINGS
        # All of them have their share.
        await line.wait_samples(30)
        assert len({handle for handle, _ in samples(line.told, ME.endpoint)}) == 10

    on_line(scene)


def test_pace_keeps_a_rate_and_does_not_save_up():
    pace = Pace(100)
    assert [pace.reserve(0), pace.reserve(0), pace.reserve(5_000_000)] == [
        0,
        10_000_000,
        20_000_000,
    ]
    assert [pace.reserve(10**9), pace.reserve(10**9)] == [10**9, 10**9 + 10_000_000]


def test_other_requests_have_turns_beside_notifications():
    async def scene(client, engine):
        for subindex in (1, 2, 3):
            await handle_of(client, asked(0x1018_0000 | subindex))
        engine.requests.clear()
        for _ in range(20):
            await client.good(DRIVE, Read(IndexGroup.SDO, WINDOW, 4))
        await client.write(DRIVE, IndexGroup.SDO, WINDOW, b"\1\0\0\0")
        assert all(isinstance(each, ExchangeMailbox) for each in engine.requests)
        # 21 requests of the client among at most as many readings.
        assert len(engine.requests) <= 60

    play(scene)
