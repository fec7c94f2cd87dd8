from __future__ import annotations

from contextlib import ExitStack

import pytest

from eap.control.device import StateAnswer, StateError
from eap.ops.routing import (
    STATE_S,
    AmsRefusedError,
    open_ams,
    read_state,
    request_state,
)
from tests.support.adstarget import TARGET, AdsTarget
from tests.support.oddevice import mixer


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def pause(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def target(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path))
    with ExitStack() as stack:
        yield AdsTarget(mixer(), stack)


def bring(wanted: str, clock: Clock | None = None):
    clock = clock or Clock()
    with open_ams(TARGET, None) as device:
        return request_state(device, wanted, clock=clock, pause=clock.pause)


def test_state_is_shown_and_requested(target):
    with open_ams(TARGET, None) as device:
        assert read_state(device) == StateAnswer("PREOP", None)
    assert bring("OP") == StateAnswer("OP", None)
    target.slow = 3
    clock = Clock()
    assert bring("BOOT", clock) == StateAnswer("BOOT", None)
    assert clock.now > 0.1


def test_request_state_of_a_device_that_keeps_its_state_fails(target):
    target.slow = 1000
    clock = Clock()
    found = bring("OP", clock)
    assert found == StateAnswer("PREOP", StateError(0, "not there within 10 s"))
    assert clock.now >= STATE_S


@pytest.mark.parametrize("error", [0x723, 0x1B])
def test_ams_device_without_an_appliance_is_refused(target, error):
    with open_ams(TARGET, None) as device:
        target.error = error
        with pytest.raises(AmsRefusedError):
            request_state(device, "OP")
