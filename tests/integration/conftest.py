"""Fixtures of the tests of running appliances.

A module with ``IS_ABOUT_PROCESSES`` starts them as programs, others fork them.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.appliance import Plants, plants


@pytest.fixture
def farm(request: pytest.FixtureRequest) -> Iterator[Plants]:
    """Runs appliances and ends them."""
    with plants() as folder:
        folder.is_real = hasattr(request.module, "IS_ABOUT_PROCESSES")
        yield folder


@pytest.fixture(scope="module")
def module_farm(request: pytest.FixtureRequest) -> Iterator[Plants]:
    """Runs appliances that the tests of a file share, and ends them."""
    with plants() as folder:
        folder.is_real = hasattr(request.module, "IS_ABOUT_PROCESSES")
        folder.state = folder.folder / "state"
        yield folder
