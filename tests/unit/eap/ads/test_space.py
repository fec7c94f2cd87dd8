from __future__ import annotations

from collections.abc import Callable

import pytest

from eap.ads.operation import AdsRefusedError
from eap.ads.space import AdsSpace, fixed_size_source


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


def test_what_gets_longer_or_shorter_ends() -> None:
    octets = [b"four", b"more", b"five!", b"two", b"two"]
    source = fixed_size_source(lambda: octets.pop(0), 4)
    assert source() == b"more"
    for _ in range(2):
        with pytest.raises(AdsRefusedError, match="SIZE"):
            source()
    with pytest.raises(AdsRefusedError, match="SIZE"):
        fixed_size_source(lambda: octets.pop(0), 4)
