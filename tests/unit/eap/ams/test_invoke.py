from __future__ import annotations

from eap.ams.inflight import InvokeIds, is_marked


def test_ids_are_marked_and_differ() -> None:
    ids = InvokeIds(123_456_789)
    given = [ids.allocate(()) for _ in range(10_000)]
    assert len(set(given)) == len(given)
    assert all(map(is_marked, given))
    assert all(0 < each < 1 << 32 for each in given)


def test_ids_of_clients_who_count_are_not_marked() -> None:
    assert not any(map(is_marked, range(100_000)))
    high = [each for each in range(1 << 31, (1 << 31) + 100_000) if is_marked(each)]
    assert len(high) < 1000


def test_taken_ids_are_left_out_and_numbers_come_round() -> None:
    first = InvokeIds(5).allocate(())
    assert InvokeIds(5).allocate({first}) == InvokeIds(6).allocate(())
    last = InvokeIds((1 << 22) - 2)
    assert last.allocate(()) & (1 << 22) - 1 == (1 << 22) - 1
    assert last.allocate(()) & (1 << 22) - 1 == 0
    assert is_marked(last.allocate(()))
