from __future__ import annotations

import pytest

from eap.ads.operation import AdsRefusedError
from eap.ads.space import DeviceDataSpace, al_state_for, states_of
from eap.codec.ads import AdsState, AdsStates, IndexGroup

DATA = IndexGroup.DEVICE_DATA


@pytest.mark.parametrize(
    ("al_state", "ads_state"),
    [
        (1, AdsState.INIT),
        (2, AdsState.CONFIG),
        (3, AdsState.LOAD_CONFIG),
        (4, AdsState.STOP),
        (8, AdsState.RUN),
        (0, AdsState.INVALID),
    ],
)
def test_states_that_are_told(al_state: int, ads_state: AdsState) -> None:
    assert states_of(al_state) == AdsStates(ads_state, al_state)


def test_states_that_are_asked_for() -> None:
    for al_state in (1, 2, 4, 8):
        assert al_state_for(states_of(al_state).ads_state) == al_state
    assert al_state_for(AdsState.RESET) == 1
    assert al_state_for(AdsState.RECONFIG) == 2
    with pytest.raises(AdsRefusedError, match="VALUE"):
        al_state_for(AdsState.SHUTDOWN)


def test_device_data_is_read_and_watched() -> None:
    states = [AdsStates(AdsState.RUN, 8)]
    space = DeviceDataSpace(lambda: states[0])
    assert space.read(DATA, 0, 100) == b"\5\0\x08\0"
    assert space.read(DATA, 0, 2) == b"\5\0"
    assert space.read(DATA, 2, 4) == b"\x08\0"
    source = space.watch(DATA, 0, 4)
    assert source() == b"\5\0\x08\0"
    states[0] = AdsStates(AdsState.STOP, 4)
    assert source() == b"\6\0\4\0"


def test_device_data_that_is_not_there() -> None:
    space = DeviceDataSpace(lambda: AdsStates(AdsState.RUN, 8))
    with pytest.raises(AdsRefusedError, match="INDEX_OFFSET"):
        space.read(DATA, 1, 2)
    with pytest.raises(AdsRefusedError, match="SIZE"):
        space.watch(DATA, 2, 4)
