from __future__ import annotations

from collections.abc import Callable

import pytest

from eap.aoe.ads_operation import AdsRefusedError
from eap.aoe.ads_space import AdsSpace


@pytest.mark.parametrize(
    "attempt",
    [
        lambda space: space.read(1, 2, 3),
        lambda space: space.write(1, 2, b""),
        lambda space: space.read_write(1, 2, 3, b""),
        lambda space: space.watch(1, 2, 3),
    ],
)
def test_what_is_not_overridden_is_refused(attempt: Callable[[AdsSpace], object]) -> None:
    with pytest.raises(AdsRefusedError, match="ACCESS"):
        attempt(AdsSpace())
