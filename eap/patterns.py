"""Patterns of names: ``*`` stands for any text, ``?`` for any one character."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

WILD = frozenset("*?")


def is_pattern(text: str) -> bool:
    """Return whether *text* has a wildcard; otherwise it is the name itself."""
    return not WILD.isdisjoint(text)


def compile_patterns(patterns: Iterable[str], character: str = ".") -> Callable[[str], bool]:
    """Return a function that says whether a whole name fits one of *patterns*.

    Args:
        patterns: The patterns; no name fits none.
        character: Regular expression of a character that a wildcard stands for.
    """
    expressions = [_expression(each, character) for each in patterns]
    found = re.compile("|".join(expressions) if expressions else "(?!)", re.DOTALL)
    return lambda name: found.fullmatch(name) is not None


def match_names(pattern: str, names: Iterable[str]) -> list[str]:
    """Return the *names* that fit *pattern*; ``*`` stands for any text without slashes."""
    if "*" not in pattern:
        return [name for name in names if name == pattern]
    fits = compile_patterns([pattern], "[^/]")
    return [name for name in names if fits(name)]


def _expression(pattern: str, character: str) -> str:
    first, *others = (_piece(each, character) for each in pattern.split("*"))
    if not others:
        return first
    # Each piece is taken at its first place, and kept there: to go back and try the others, too,
    # takes longer than any process runs for a pattern of many asterisks, which clients may send.
    middle = "".join(f"(?>{character}*?{each})" for each in others[:-1])
    return f"{first}{middle}{character}*{others[-1]}"


def _piece(text: str, character: str) -> str:
    return "".join(character if each == "?" else re.escape(each) for each in text)
