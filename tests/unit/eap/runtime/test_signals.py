"""Signals become readable, and the old handlers come back."""

from __future__ import annotations

import os
import select
import signal

import pytest

from eap.runtime.signals import catch_end_signals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_can_be_waited_for(number):
    before = signal.getsignal(number)
    with catch_end_signals() as fd:
        assert select.select([fd], [], [], 0)[0] == []
        os.kill(os.getpid(), number)
        assert select.select([fd], [], [], 5)[0] == [fd]
        assert os.read(fd, 8) == bytes([number])
    assert signal.getsignal(number) is before
    assert signal.set_wakeup_fd(-1) == -1
