"""Spaces of index groups: base class, states and system service."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from eap.ads.request import AdsRefusedError
from eap.ads.space import (
    AdsSpace,
    DeviceDataSpace,
    SystemSpace,
    al_state_for,
    fixed_size_source,
    states_of,
)
from eap.codec.ads import AdsState, AdsStates, AdsSystemState, IndexGroup


@pytest.mark.parametrize(
    "attempt",
    [
        lambda space: space.read(1, 2, 3),
        lambda space: space.write(1, 2, b""),
        lambda space: space.read_write(1, 2, 3, b""),
        lambda space: space.watch(1, 2, 3),
    ],
)
def test_space_refuses_operations_without_override(attempt: Callable[[AdsSpace], object]) -> None:
    with pytest.raises(AdsRefusedError, match="ACCESS"):
        attempt(AdsSpace())


def test_fixed_size_source_ends_when_length_changes() -> None:
    octets = [b"four", b"more", b"five!", b"two", b"two"]
    source = fixed_size_source(lambda: octets.pop(0), 4)
    assert source() == b"more"
    for _ in range(2):
        with pytest.raises(AdsRefusedError, match="SIZE"):
            source()
    with pytest.raises(AdsRefusedError, match="SIZE"):
        fixed_size_source(lambda: octets.pop(0), 4)


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
def test_al_states_map_to_ads_states(al_state: int, ads_state: AdsState) -> None:
    assert states_of(al_state) == AdsStates(ads_state, al_state)


def test_ads_states_map_to_al_states() -> None:
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


def test_device_data_refuses_unknown_offsets() -> None:
    space = DeviceDataSpace(lambda: AdsStates(AdsState.RUN, 8))
    with pytest.raises(AdsRefusedError, match="INDEX_OFFSET"):
        space.read(DATA, 1, 2)
    with pytest.raises(AdsRefusedError, match="SIZE"):
        space.watch(DATA, 2, 4)


def test_system_state_is_read_each_time() -> None:
    starts = iter((1, 2))
    space = SystemSpace(lambda: AdsSystemState(AdsState.RUN, 8, restart_index=next(starts)))
    assert space.read(IndexGroup.SYSTEM_STATE, 0, 16) == b"\5\0\x08\0\1\0" + bytes(10)
    assert space.read(IndexGroup.SYSTEM_STATE, 0, 6) == b"\5\0\x08\0\2\0"


def test_other_offsets_are_refused() -> None:
    space = SystemSpace(lambda: AdsSystemState(AdsState.RUN, 8))
    with pytest.raises(AdsRefusedError, match="INDEX_OFFSET"):
        space.read(IndexGroup.SYSTEM_STATE, 1, 16)
