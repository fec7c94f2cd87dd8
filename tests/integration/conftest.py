"""What the tests of running appliances share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.appliance import Plants, plants


@pytest.fixture
def farm() -> Iterator[Plants]:
    """Runs appliances and ends them."""
    with plants() as folder:
        yield folder
