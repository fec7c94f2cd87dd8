"""Restarts of a transfer: the faults that allow one, and their number."""

from __future__ import annotations

import pytest

from devicebus.errors import (
    FoeError,
    FrameLostError,
    MailboxClosedError,
    MailboxTimeoutError,
    NoMailboxError,
    WorkingCounterError,
)
from devicebus.mailbox.conversation import Progress
from eap.runtime.foe_restart import RESTARTS, RETURN_S, Restarts


@pytest.fixture
def progress():
    progress = Progress()
    progress.done = 100
    return progress


@pytest.mark.parametrize(
    ("error", "is_allowed"),
    [
        (FrameLostError("x"), True),
        (MailboxClosedError("x"), True),
        (MailboxTimeoutError("x"), True),
        (WorkingCounterError("x", expected=1, received=0), True),
        (NoMailboxError("x"), False),
        (FoeError("x", code=1), False),
    ],
)
def test_restart_follows_faults_of_the_bus_only(progress, error, is_allowed):
    restarts = Restarts(progress, lambda: True, lambda: 0.0)
    assert restarts.allows(error) is is_allowed
    assert (restarts.count, progress.done) == ((1, 0) if is_allowed else (0, 100))


def test_foe_restart_before_first_data_is_refused(progress):
    progress.done = 0
    restarts = Restarts(progress, lambda: True, lambda: 0.0)
    assert not restarts.allows(FrameLostError("x"))


def test_restart_needs_data_that_can_be_had_again(progress):
    assert not Restarts(progress, lambda: False, lambda: 0.0).allows(FrameLostError("x"))


def test_restarts_are_bounded_in_number_and_in_time(progress):
    now_s = [0.0]
    restarts = Restarts(progress, lambda: True, lambda: now_s[0])
    for number in range(1, 1 + RESTARTS):
        progress.done = 100
        assert restarts.allows(FrameLostError(f"fault {number}"))
        assert (restarts.count, restarts.reason) == (number, f"fault {number}")
    assert restarts.allows(MailboxClosedError("not back yet"))
    now_s[0] += RETURN_S
    assert not restarts.allows(MailboxClosedError("not back yet"))
    progress.done = 100
    assert not restarts.allows(FrameLostError("once more"))
