from __future__ import annotations

import pytest

from eap.ads.operation import AdsRefusedError
from eap.ads.space import SystemSpace
from eap.codec.ads import AdsState, AdsSystemState, IndexGroup


def test_state_is_asked_for_each_time() -> None:
    starts = iter((1, 2))
    space = SystemSpace(lambda: AdsSystemState(AdsState.RUN, 8, restart_index=next(starts)))
    assert space.read(IndexGroup.SYSTEM_STATE, 0, 16) == b"\5\0\x08\0\1\0" + bytes(10)
    assert space.read(IndexGroup.SYSTEM_STATE, 0, 6) == b"\5\0\x08\0\2\0"


def test_other_offsets_are_refused() -> None:
    space = SystemSpace(lambda: AdsSystemState(AdsState.RUN, 8))
    with pytest.raises(AdsRefusedError, match="INDEX_OFFSET"):
        space.read(IndexGroup.SYSTEM_STATE, 1, 16)
