"""Fixtures of the tests of running appliances."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.appliance import Plants, plants


@pytest.fixture
def farm() -> Iterator[Plants]:
    """Runs appliances and ends them."""
    with plants() as folder:
        yield folder


@pytest.fixture(scope="module")
def module_farm() -> Iterator[Plants]:
    """Runs appliances that the tests of a file share, and ends them."""
    with plants() as folder:
        folder.state = folder.folder / "state"
        yield folder
