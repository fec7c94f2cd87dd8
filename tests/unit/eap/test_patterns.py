from __future__ import annotations

from fnmatch import fnmatchcase

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.patterns import compile_patterns, is_pattern


@pytest.mark.parametrize(
    ("pattern", "name", "fits"),
    [
        ("load", "load", True),
        ("load", "loads", False),
        ("*", "", True),
        ("*load", "left_load", True),
        ("left*", "left_load", True),
        ("l*d", "ld", True),
        ("ab*ba", "aba", False),
        ("*a*a", "a", False),
        ("lo?d", "load", True),
        ("lo?d", "lod", False),
        ("axis[2]", "axis[2]", True),
        ("axis[2]", "axis2", False),
    ],
)
def test_pattern_fits_whole_names(pattern: str, name: str, fits: bool) -> None:
    assert compile_patterns([pattern])(name) is fits


def test_name_fits_one_of_several_patterns_and_none_of_none():
    assert compile_patterns(["a*", "*b"])("cb")
    assert not compile_patterns([])("")


def test_wildcards_stay_within_the_given_characters():
    fits = compile_patterns(["*/?"], "[^/]")
    assert fits("island/a")
    assert not fits("island/bus/a")
    assert not fits("island//")


@given(st.text("ab*?/", max_size=12), st.text("ab/", max_size=12))
def test_patterns_fit_as_those_of_shells(pattern: str, name: str) -> None:
    assert compile_patterns([pattern])(name) == fnmatchcase(name, pattern)


def test_pattern_of_many_asterisks_is_decided_at_once():
    # With a regular expression that tries all places of all pieces, this does not end.
    assert not compile_patterns(["*a" * 200 + "b"])("a" * 5000)


def test_wildcard_makes_a_pattern():
    assert is_pattern("lo*")
    assert is_pattern("lo?d")
    assert not is_pattern("load[2]")
