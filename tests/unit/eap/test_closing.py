from __future__ import annotations

import pytest

from eap.closeable import Closeable


class Transport(Closeable):
    def __init__(self) -> None:
        self.is_open = True

    def close(self) -> None:
        self.is_open = False


def test_it_is_closed_at_the_end_whatever_happens() -> None:
    with Transport() as door:
        assert door.is_open
    assert not door.is_open
    with pytest.raises(ValueError, match="oh"), Transport() as door:
        raise ValueError("oh")
    assert not door.is_open
