from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ads.device import FIRST_CHANGE_NS, AdsDevice
from eap.ads.notifications import AdsClient
from eap.ads.request import MAX_ANSWER, Read, Write
from eap.ads.space import AdsSpace
from eap.codec.ads import AdsError, AdsState, IndexGroup
from eap.codec.adsnotification import AddNotification, TransMode, decode_notification
from eap.codec.ams import AmsAnswer, AmsCommand
from eap.ids import Endpoint, NetId
from tests.support.adsdevice import DictStore, Station, info, variable_device

G = IndexGroup
CLIENT = AdsClient(Endpoint("tcp", "1"), NetId.parse("1.2.3.4.1.1"), 30000)


class Bench:
    """A device with variables, and shorter ways to ask it."""

    def __init__(self) -> None:
        self.store = DictStore()
        self.station = Station()
        self.device, self.space = variable_device(self.store, self.station)

    def ask(self, command: int, form: str = "", *values, now_ns: int = 0, **options):
        body = struct.pack(f"<{form}", *values)
        return self.device.answer(command, body, CLIENT, now_ns, **options)

    def result(self, command: int, form: str = "", *values, **options) -> int:
        answer = self.ask(command, form, *values, **options)
        assert not answer.error_code
        return int.from_bytes(answer.data[:4], "little")

    def handle(self, name: str) -> int:
        octets = name.encode()
        form = f"4I{len(octets)}s"
        answer = self.ask(9, form, G.SYMBOL_HANDLE, 0, 4, len(octets), octets)
        return int.from_bytes(answer.data[8:12], "little")


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_info_and_states(bench) -> None:
    answer = bench.ask(AmsCommand.READ_DEVICE_INFO)
    assert answer.data == bytes(4) + b"\3\1\xb8\x0fisland-01".ljust(20, b"\0")
    assert bench.ask(AmsCommand.READ_STATE).data == bytes(4) + b"\5\0\x08\0"
    assert bench.ask(AmsCommand.READ, "3I", G.DEVICE_DATA, 0, 4).data[8:] == b"\5\0\x08\0"


def test_device_write_control_reaches_its_handler(bench) -> None:
    assert bench.result(AmsCommand.WRITE_CONTROL, "2HI", AdsState.CONFIG, 8, 0) == 0
    assert bench.station.al_state == 2
    assert bench.result(AmsCommand.WRITE_CONTROL, "2HI", AdsState.IDLE, 8, 0) == AdsError.VALUE
    without = AdsDevice(info("none"), bench.station.states, [])
    answer = without.answer(AmsCommand.WRITE_CONTROL, bytes(8), CLIENT, 0)
    assert answer.data == b"\1\7\0\0"


def test_values_are_read_and_written(bench) -> None:
    handle = bench.handle("flags")
    answer = bench.ask(AmsCommand.READ, "3I", G.VALUE_BY_HANDLE, handle, 2)
    assert answer.data == bytes.fromhex("00000000 02000000 0180")
    assert bench.result(AmsCommand.WRITE, "3IH", G.VALUE_BY_HANDLE, handle, 2, 7) == 0
    assert bench.store.get("flags") == 7


@pytest.mark.parametrize(
    ("command", "form", "values", "result"),
    [
        (AmsCommand.READ, "3I", (0x1234, 0, 4), AdsError.INDEX_GROUP),
        (AmsCommand.WRITE, "3I", (0x1234, 0, 0), AdsError.INDEX_GROUP),
        (AmsCommand.READ_WRITE, "4I", (0x1234, 0, 4, 0), AdsError.INDEX_GROUP),
        (AmsCommand.READ_WRITE, "4I", (G.DEVICE_DATA, 0, 4, 0), AdsError.ACCESS),
        (AmsCommand.READ, "2I", (G.DEVICE_DATA, 0), AdsError.SIZE),
        (AmsCommand.DELETE_NOTIFICATION, "I", (5,), AdsError.NOTIFICATION_HANDLE),
        (AmsCommand.ADD_NOTIFICATION, "6I16x", (0x1234, 0, 4, 4, 0, 0), AdsError.INDEX_GROUP),
        (AmsCommand.ADD_NOTIFICATION, "6I16x", (G.DEVICE_DATA, 0, 4, 1, 0, 0), AdsError.TRANS_MODE),
    ],
)
def test_refusals_are_results(bench, command: int, form: str, values, result: int) -> None:
    assert bench.result(command, form, *values) == result


@pytest.mark.parametrize("command", [0, AmsCommand.NOTIFICATION, 0x1234])
def test_unknown_commands_are_an_error_of_the_header(bench, command: int) -> None:
    assert bench.ask(command) == AmsAnswer(error_code=AdsError.COMMAND)


def test_device_adds_samples_and_deletes_notifications(bench) -> None:
    added = bench.ask(
        AmsCommand.ADD_NOTIFICATION,
        "6I16x",
        G.VALUE_BY_HANDLE,
        bench.handle("flags"),
        2,
        TransMode.SERVER_ON_CHANGE,
        0,
        0,
    )
    result, handle = struct.unpack("<2I", added.data)
    assert not result
    ((client, data),) = bench.device.notifications.handle_cycle(FIRST_CHANGE_NS, 99)
    assert client == CLIENT
    assert decode_notification(data) == [(99, ((handle, b"\x01\x80"),))]
    assert bench.result(AmsCommand.DELETE_NOTIFICATION, "I", handle) == 0
    assert bench.device.notifications.handle_cycle(FIRST_CHANGE_NS + 1, 100) == []


def test_sums_are_done_item_by_item(bench) -> None:
    items = struct.pack("<3I", G.VALUE_BY_HANDLE, bench.handle("flags"), 2)
    items += struct.pack("<3I", 0x1234, 0, 1)
    form = f"4I{len(items)}s"
    answer = bench.ask(AmsCommand.READ_WRITE, form, G.SUM_READ, 2, 11, len(items), items)
    assert answer.data == bytes.fromhex("00000000 0b000000 00000000 02070000 0180 00")


def test_operations_can_be_done_one_by_one(bench) -> None:
    handle = bench.handle("flags")
    assert bench.device.perform(Read(G.VALUE_BY_HANDLE, handle, 2), CLIENT, 0) == (0, b"\1\x80", "")
    assert bench.device.perform(Write(G.DATA, 1, b""), CLIENT, 0).result == AdsError.SIZE


class Talkative(AdsSpace):
    """Gives more than there is room for."""

    groups = (1,)

    def read(self, group: int, offset: int, length: int) -> bytes:
        return bytes(length + 1)

    def read_write(self, group: int, offset: int, length: int, data: bytes) -> bytes:
        return bytes(length + 1)


def test_device_refuses_data_longer_than_requested(bench) -> None:
    device = AdsDevice(info("talkative"), bench.station.states, [Talkative()])
    for command, body in ((AmsCommand.READ, bytes(12)), (AmsCommand.READ_WRITE, bytes(16))):
        answer = device.answer(command, b"\1\0\0\0" + body[4:], CLIENT, 0)
        assert answer.data == struct.pack("<2I", AdsError.SIZE, 0)


GROUPS = st.one_of(st.sampled_from(list(IndexGroup)), st.integers(0, 0xFFFF_FFFF))
SMALL = st.one_of(st.integers(0, 40), st.integers(0, 0xFFFF_FFFF))


@given(st.integers(0, 10), GROUPS, SMALL, SMALL, SMALL, st.binary(max_size=90), st.booleans())
def test_anything_is_answered(command, group, offset, length, behind, noise, exact) -> None:
    bench = Bench()
    head = struct.pack("<3I", group, offset, length)
    if command == AmsCommand.READ_WRITE:
        head += struct.pack("<I", len(noise) if exact else behind)
    answer = bench.device.answer(command, head + noise, CLIENT, 0)
    assert answer.error_code or 4 <= len(answer.data) <= MAX_ANSWER + 8
    for _, data in bench.device.notifications.handle_cycle(1, 1):
        assert decode_notification(data)


def test_sum_of_notifications_belongs_to_the_client(bench) -> None:
    item = AddNotification(
        G.VALUE_BY_HANDLE, bench.handle("flags"), 2, TransMode.SERVER_CYCLE, 0, 0
    ).encode()
    form = f"4I{2 * len(item)}s"
    answer = bench.ask(9, form, G.SUM_ADD_NOTIFICATION, 2, 16, 2 * len(item), item * 2)
    _, _, first, one, second, two = struct.unpack("<6I", answer.data)
    assert (first, second) == (0, 0)
    handles = struct.pack("<2I", one, two)
    answer = bench.ask(9, "4I8s", G.SUM_DELETE_NOTIFICATION, 2, 8, 8, handles)
    assert answer.data == bytes.fromhex("00000000 08000000 00000000 00000000")
