from __future__ import annotations

import pytest

from eap.release import RELEASE, are_neighbours


@pytest.mark.parametrize(
    ("one", "other", "are_beside"),
    [
        ("0.1.0", "0.1.7", True),
        ("0.1.0", "0.2.0", True),
        ("0.3.0", "0.1.0", False),
        ("0.2.0.dev5+g1234567", "0.1.0", True),
        ("0.9.4", "1.0.0", True),
        ("0.9.4", "1.1.0", False),
        ("1.0.0", "3.0.0", False),
        ("", "0.1.0", False),
        ("unknown", "unknown", True),
        (RELEASE, RELEASE, True),
    ],
)
def test_releases_work_together_over_one_minor_release(
    one: str, other: str, *, are_beside: bool
) -> None:
    assert are_neighbours(one, other) is are_beside
    assert are_neighbours(other, one) is are_beside
