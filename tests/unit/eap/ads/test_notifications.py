from __future__ import annotations

from itertools import chain

import pytest

from eap.ads import notifications as ads_notifications
from eap.ads.notifications import (
    FULL_PACKET,
    MAX_WATCHED,
    AdsClient,
    Notice,
    NotificationTable,
    handle_numbers,
)
from eap.ads.request import AdsRefusedError
from eap.codec.ads import AdsError
from eap.codec.adsnotification import (
    AddNotification,
    NotificationSample,
    Stamp,
    TransMode,
    decode_notification,
    to_filetime,
)
from eap.codec.ams import AmsHeader, decode_packet
from eap.ids import Endpoint, NetId

MS = 1_000_000
ME = AdsClient(Endpoint("tcp", "1"), NetId(b"client"), 30000)
YOU = ME._replace(endpoint=Endpoint("tcp", "2"))
OTHER = ME._replace(port=30001)
CYCLE = TransMode.SERVER_CYCLE
CHANGE = TransMode.SERVER_ON_CHANGE


class Value:
    """Something to watch; None is refused with *refusal*."""

    def __init__(self, octets: bytes = b"\0") -> None:
        self.octets: bytes | None = octets
        self.refusal = AdsError.BUSY
        self.reads = 0

    def __call__(self) -> bytes:
        self.reads += 1
        if self.octets is None:
            raise AdsRefusedError(self.refusal)
        return self.octets


def asked(mode: int, *, cycle_ms: float = 0, delay_ms: float = 0, length: int = 1):
    return AddNotification(0, 0, length, mode, int(delay_ms * 10_000), int(cycle_ms * 10_000))


def cycle(table: NotificationTable, now_ms: float) -> list[tuple[object, list[Stamp]]]:
    """End a cycle; return clients with the stamps that they are told of."""
    now_ns = int(now_ms * MS)
    notices = table.handle_cycle(now_ns, to_filetime(now_ns))
    return [(client, decode_notification(data)) for client, data in notices]


def stamp(now_ms: float, *samples: tuple[int, bytes]) -> Stamp:
    return Stamp(
        to_filetime(int(now_ms * MS)), tuple(NotificationSample(*sample) for sample in samples)
    )


@pytest.fixture
def table() -> NotificationTable:
    return NotificationTable()


@pytest.mark.parametrize("mode", [TransMode.SERVER_CYCLE, TransMode.SERVER_CYCLE_2])
def test_cyclic_ones_are_sampled_in_their_cycle(table, mode: int) -> None:
    value = Value(b"a")
    handle = table.add(ME, asked(mode, cycle_ms=20), value, 0)
    told = [(now, cycle(table, now)) for now in range(10, 80, 10)]
    assert [(now, stamps) for now, stamps in told if stamps] == [
        (now, [(ME, [stamp(now, (handle, b"a"))])]) for now in (10, 20, 40, 60)
    ]
    assert value.reads == 4


def test_first_sample_follows_the_answer_to_the_request(table) -> None:
    table.add(ME, asked(CYCLE), Value(), 5 * MS)
    assert cycle(table, 5) == []
    assert len(cycle(table, 5.1)) == 1


@pytest.mark.parametrize(
    ("mode", "reads"), [(CYCLE, [1, 1, 2, 2, 2, 3]), (CHANGE, [0, 1, 1, 1, 2, 2])]
)
def test_first_sample_on_change_is_delayed_and_cyclic_ones_are_not(mode: int, reads: list[int]):
    table = NotificationTable(first_change_ns=20 * MS)
    value = Value(b"a")
    table.add(ME, asked(mode, cycle_ms=30), value, 0)
    found = []
    for now in range(10, 70, 10):
        cycle(table, now)
        found.append(value.reads)
    assert found == reads


def test_a_cycle_of_zero_is_every_cycle(table) -> None:
    table.add(ME, asked(CYCLE), Value(), 0)
    assert [len(cycle(table, now)) for now in (1, 2, 3)] == [1, 1, 1]


@pytest.mark.parametrize("mode", [TransMode.SERVER_ON_CHANGE, TransMode.SERVER_ON_CHANGE_2])
def test_changes_are_sampled_from_the_first_value(table, mode: int) -> None:
    value = Value(b"a")
    handle = table.add(ME, asked(mode), value, 0)
    assert cycle(table, 1) == [(ME, [stamp(1, (handle, b"a"))])]
    assert cycle(table, 2) == []
    value.octets = b"b"
    assert cycle(table, 3) == [(ME, [stamp(3, (handle, b"b"))])]
    assert cycle(table, 4) == []


def test_a_change_back_between_two_looks_is_not_seen(table) -> None:
    value = Value(b"a")
    table.add(ME, asked(CHANGE, cycle_ms=30), value, 0)
    assert cycle(table, 10)
    value.octets = b"b"
    assert cycle(table, 20) == []
    value.octets = b"a"
    assert [cycle(table, now) for now in (30, 40)] == [[], []]
    value.octets = b"c"
    assert cycle(table, 60) != []


def test_mean_distance_is_kept_where_cycles_do_not_divide_it(table) -> None:
    table.add(ME, asked(CYCLE, cycle_ms=15), Value(), 0)
    told = [now for now in range(10, 160, 10) if cycle(table, now)]
    assert told == [10, 20, 30, 50, 60, 80, 90, 110, 120, 140, 150]


def test_cycles_that_are_a_little_early_count(table) -> None:
    table.add(ME, asked(CYCLE, cycle_ms=10), Value(), 0)
    assert [bool(cycle(table, now)) for now in (10, 19.9, 30.1, 39.8, 50)] == [True] * 5


def test_nothing_is_made_up_for_after_a_pause(table) -> None:
    table.add(ME, asked(CYCLE, cycle_ms=10), Value(), 0)
    assert [len(cycle(table, now)) for now in (10, 1000, 1001, 1010)] == [1, 1, 0, 1]


def test_samples_of_one_cycle_share_a_stamp_and_wait_for_others(table) -> None:
    one, two = Value(b"1"), Value(b"2")
    first = table.add(ME, asked(CYCLE, delay_ms=25), one, 0)
    second = table.add(ME, asked(CHANGE, delay_ms=50), two, 0)
    assert [cycle(table, now) for now in (10, 20, 30)] == [[], [], []]
    two.octets = b"3"
    assert cycle(table, 40) == [
        (
            ME,
            [
                stamp(10, (first, b"1"), (second, b"2")),
                stamp(20, (first, b"1")),
                stamp(30, (first, b"1")),
                stamp(40, (first, b"1"), (second, b"3")),
            ],
        )
    ]
    assert cycle(table, 50) == []


def test_sample_with_shortest_delay_sends_waiting_samples(table) -> None:
    patient = table.add(ME, asked(CHANGE, delay_ms=1000), Value(b"p"), 0)
    assert cycle(table, 10) == []
    hasty = table.add(ME, asked(CHANGE), Value(b"h"), 10 * MS)
    assert cycle(table, 20) == [(ME, [stamp(10, (patient, b"p")), stamp(20, (hasty, b"h"))])]


def test_full_packets_go_without_waiting(table) -> None:
    size = FULL_PACKET // 2
    table.add(ME, asked(CYCLE, delay_ms=10_000, length=size), Value(bytes(size)), 0)
    assert cycle(table, 10) == []
    told = cycle(table, 20)
    assert [stamps[0].time for _, stamps in told] == [stamp(10).time]
    big = table.add(ME, asked(CHANGE, length=MAX_WATCHED), Value(bytes(MAX_WATCHED)), 20 * MS)
    told = cycle(table, 30)
    samples = [sample for _, stamps in told for each in stamps for sample in each.samples]
    assert [len(sample.data) for sample in samples] == [size, size, MAX_WATCHED]
    assert samples[-1].handle == big


def test_handles_belong_to_their_client(table) -> None:
    mine = table.add(ME, asked(CYCLE), Value(), 0)
    yours = table.add(YOU, asked(CYCLE), Value(), 0)
    assert mine != yours
    for client, handle in ((YOU, mine), (OTHER, mine), (ME, 77), (ME, 0)):
        with pytest.raises(AdsRefusedError, match="NOTIFICATION_HANDLE"):
            table.delete(client, handle)
    assert [client for client, _ in cycle(table, 1)] == [ME, YOU]
    table.delete(ME, mine)
    assert [client for client, _ in cycle(table, 2)] == [YOU]
    assert tuple(table._clients) == (YOU,)


def test_notifications_of_closed_connection_are_removed(table) -> None:
    for client in (ME, ME, OTHER, YOU):
        table.add(client, asked(CYCLE, delay_ms=100), Value(), 0)
    assert cycle(table, 1) == []
    table.forget(ME.endpoint)
    assert tuple(table._clients) == (YOU,)
    assert [client for client, _ in cycle(table, 1000)] == [YOU]
    table.forget(YOU.endpoint)
    table.forget(YOU.endpoint)
    assert table.stats()[:2] == (0, 0)
    assert table.next_timeout() is None


def test_packet_of_a_notice() -> None:
    device = NetId(b"device")
    header, body = decode_packet(Notice(ME, b"data").encode(device, 300))
    assert header == AmsHeader(ME.net_id, ME.port, device, 300, 8, 4, 4)
    assert body == b"data"


def test_waiting_samples_are_dropped_with_the_last_notification(table) -> None:
    handle = table.add(ME, asked(CYCLE, delay_ms=100), Value(), 0)
    assert cycle(table, 1) == []
    table.delete(ME, handle)
    assert cycle(table, 1000) == []
    assert tuple(table._clients) == ()


def test_source_that_is_busy_is_read_again(table) -> None:
    value = Value(b"a")
    handle = table.add(ME, asked(CHANGE), value, 0)
    value.octets = None
    assert cycle(table, 1) == []
    value.octets = b"a"
    assert cycle(table, 2) == [(ME, [stamp(2, (handle, b"a"))])]


def test_a_source_that_fails_for_good_ends_its_notification(table) -> None:
    value = Value(b"a")
    other = table.add(ME, asked(CYCLE, delay_ms=100), Value(b"o"), 0)
    handle = table.add(ME, asked(CYCLE, delay_ms=100), value, 0)
    assert cycle(table, 1) == []
    value.octets, value.refusal = None, AdsError.SYMBOL_VERSION
    assert cycle(table, 2) == [
        (ME, [stamp(1, (other, b"o"), (handle, b"a")), stamp(2, (other, b"o"))]),
        (ME, [stamp(2, (handle, b""))]),
    ]
    with pytest.raises(AdsRefusedError):
        table.delete(ME, handle)
    assert table.stats() == (1, 1, 3, 2, 1)


def test_a_last_source_that_fails_ends_its_client(table) -> None:
    value = Value()
    value.octets, value.refusal = None, AdsError.NOT_FOUND
    handle = table.add(ME, asked(CYCLE), value, 0)
    assert cycle(table, 1) == [(ME, [stamp(1, (handle, b""))])]
    assert tuple(table._clients) == ()


def test_table_reports_new_notifications(table) -> None:
    heard: list[int] = []
    table.on_add = lambda: heard.append(table.stats().notifications)
    table.add(ME, asked(CYCLE), Value(), 0)
    with pytest.raises(AdsRefusedError):
        table.add(ME, asked(TransMode.NONE), Value(), 0)
    assert heard == [1]


def test_next_timeout_is_that_of_samples_and_of_packets(table) -> None:
    assert table.next_timeout() is None
    table.delete(ME, table.add(ME, asked(CYCLE), Value(), 0))
    assert table.next_timeout() is None
    table.add(ME, asked(CYCLE, cycle_ms=80, delay_ms=5), Value(), 0)
    assert table.next_timeout() == 1
    assert cycle(table, 10) == []
    assert table.next_timeout() == 15 * MS
    assert cycle(table, 15)
    assert table.next_timeout() == 70 * MS


@pytest.mark.parametrize(
    ("request_", "result"),
    [
        (asked(TransMode.NONE), "TRANS_MODE"),
        (asked(TransMode.CLIENT_CYCLE), "TRANS_MODE"),
        (asked(TransMode.CLIENT_ON_CHANGE), "TRANS_MODE"),
        (asked(TransMode.CLIENT_1_REQUEST), "TRANS_MODE"),
        (asked(0xFFFF_FFFF), "TRANS_MODE"),
        (asked(CYCLE, length=0), "WATCH_SIZE"),
        (asked(CYCLE, length=MAX_WATCHED + 1), "WATCH_SIZE"),
    ],
)
def test_requests_that_are_refused(table, request_: AddNotification, result: str) -> None:
    with pytest.raises(AdsRefusedError, match=result):
        table.add(ME, request_, Value(), 0)
    assert table.stats() == (0, 0, 0, 0, 0)


def test_clients_and_their_handles_are_bounded(table, monkeypatch) -> None:
    monkeypatch.setattr(ads_notifications, "MAX_HANDLES", 3)
    monkeypatch.setattr(ads_notifications, "MAX_CLIENTS", 2)
    handles = [table.add(ME, asked(CYCLE), Value(), 0) for _ in range(3)]
    table.add(YOU, asked(CYCLE), Value(), 0)
    for client in (ME, OTHER):
        with pytest.raises(AdsRefusedError, match="NO_MORE_HANDLES"):
            table.add(client, asked(CYCLE), Value(), 0)
    table.delete(ME, handles[0])
    assert table.add(ME, asked(CYCLE), Value(), 0) not in handles


def test_handles_wrap_around() -> None:
    numbers = handle_numbers(0xFFFF_FFFF)
    table = NotificationTable(handles=chain((1,), numbers))
    kept = table.add(ME, asked(CYCLE), Value(), 0)
    assert table.add(ME, asked(CYCLE), Value(), 0) == 0xFFFF_FFFF
    assert kept == 1
    assert table.add(ME, asked(CYCLE), Value(), 0) == 2


def test_notifications_that_come_and_go_leave_nothing_behind(table) -> None:
    for n in range(1000):
        handle = table.add(ME, asked(CYCLE, cycle_ms=100), Value(), n)
        table.delete(ME, handle)
    assert len(table._due) < 20
    assert table.stats()[:2] == (0, 0)
