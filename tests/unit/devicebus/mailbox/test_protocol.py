from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.conversation import CounterCheck, next_counter
from devicebus.mailbox.protocol import MINIMUM_SIZE, MailboxSizes, raise_mailbox_error
from eap.codec.mailbox import MailboxError


def test_mailbox_sizes_include_the_header() -> None:
    sizes = MailboxSizes(256, 128)
    assert (sizes.to_slave, sizes.to_master, sizes.data_to_master) == (256, 128, 122)
    sizes.set(MINIMUM_SIZE, MINIMUM_SIZE)
    assert sizes.data_to_master == 10


@pytest.mark.parametrize("sizes", [(15, 128), (128, 15), (0, 0)])
def test_mailbox_sizes_refuse_too_small_mailboxes(sizes: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="expected at least 16"):
        MailboxSizes(*sizes)


def test_mailbox_error_has_the_detail_of_the_standard() -> None:
    with pytest.raises(MailboxRefusedError, match="INVALID_HEADER: no length") as caught:
        raise_mailbox_error(MailboxError.INVALID_HEADER, "no length")
    assert caught.value.detail == 5


def test_next_counter_counts_from_1_to_7() -> None:
    seen = [0]
    for _ in range(9):
        seen.append(next_counter(seen[-1]))
    assert seen == [0, 1, 2, 3, 4, 5, 6, 7, 1, 2]


def test_same_counter_is_a_repeat() -> None:
    watch = CounterCheck()
    assert [watch.is_new(counter) for counter in (3, 3, 3, 4)] == [True, False, False, True]
    assert (watch.repeated, watch.gaps) == (2, 0)


def test_counter_check_accepts_0() -> None:
    watch = CounterCheck()
    assert all(watch.is_new(counter) for counter in (0, 0, 5, 0, 5))
    assert (watch.repeated, watch.gaps) == (0, 0)


def test_missing_counters_are_gaps() -> None:
    watch = CounterCheck()
    assert all(watch.is_new(counter) for counter in (6, 7, 1, 3, 1, 2))
    assert watch.gaps == 2


def test_counter_check_restart_keeps_the_counts() -> None:
    watch = CounterCheck()
    assert watch.is_new(1)
    assert not watch.is_new(1)
    watch.restart()
    assert watch.is_new(1)
    assert (watch.repeated, watch.gaps) == (1, 0)


@given(st.lists(st.integers(1, 3)))
def test_own_sequence_with_repeats_has_no_gaps(repeats: list[int]) -> None:
    watch = CounterCheck()
    counter = 0
    for times in repeats:
        counter = next_counter(counter)
        assert [watch.is_new(counter) for _ in range(times)] == [True] + [False] * (times - 1)
    assert (watch.gaps, watch.repeated) == (0, sum(repeats) - len(repeats))
