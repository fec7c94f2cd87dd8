"""Suggestion of the nearest known name for an unknown one."""

from __future__ import annotations

from collections.abc import Iterable


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the one of *known* that comes nearest to *name*, None if none comes near."""
    from difflib import get_close_matches  # takes a millisecond, and few runs need it

    found = get_close_matches(name, list(known), n=1)
    return found[0] if found else None


def nearest_in_any_case(name: str, known: Iterable[str]) -> str | None:
    """Return the same as :func:`nearest` where upper and lower case make no difference."""
    by_case = {each.upper(): each for each in known}
    near = nearest(name.upper(), by_case)
    return None if near is None else by_case[near]


def suggest(name: str, known: Iterable[str]) -> str:
    """Return ``, did you mean …?`` with the one of *known* that comes nearest, or nothing."""
    meant = nearest(name, known)
    return "" if meant is None else f", did you mean {meant}?"
