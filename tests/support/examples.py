"""Number of examples of a property that needs more or fewer of them than others."""

from __future__ import annotations

from typing import Any

from hypothesis import settings

_FEWEST = 8


def examples(number: int, **others: Any) -> settings:
    """Return settings with *number* examples of a full run, where other properties take 100.

    In a quick run they are fewer in the same proportion: ``tests/conftest.py`` has both profiles.
    """
    share = settings().max_examples / 100
    return settings(max_examples=max(round(number * share), min(number, _FEWEST)), **others)
