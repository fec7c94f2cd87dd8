"""States that are asked for by WriteControl."""

from __future__ import annotations

import pytest

from eap.ads.request import OperationOutcome, WriteControl
from eap.codec.ads import AdsError, AdsState
from eap.errors import EngineRefusedError
from eap.pd.device import DeviceState
from eap.services.ads.ads_service import control_state
from tests.support.stationengine import make_device
from tests.support.virtualtime import run_virtual


def control(device, ads_state):
    return run_virtual(control_state(device, WriteControl(ads_state, 0, b"")))


@pytest.mark.parametrize(
    ("ads_state", "state"),
    [
        (AdsState.CONFIG, DeviceState.PREOP),
        (AdsState.RECONFIG, DeviceState.PREOP),
        (AdsState.STOP, DeviceState.SAFEOP),
        (AdsState.RUN, DeviceState.OP),
    ],
)
def test_ads_states_are_those_of_the_device(stations, ads_state, state):
    device, engine = make_device(stations[0])
    assert control(device, ads_state) == OperationOutcome()
    assert engine.state is device.status.state is state


def test_refusals_say_why(stations):
    device, engine = make_device(stations[0], DeviceState.SAFEOP)
    assert control(device, AdsState.SHUTDOWN) == OperationOutcome(
        AdsError.VALUE, why="no state belongs to ADS state 12"
    )
    engine.failure = EngineRefusedError("no memory")
    refused = control(device, AdsState.RUN)
    assert refused.result == AdsError.STATE
    assert "no memory" in refused.why
