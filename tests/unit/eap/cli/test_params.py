from __future__ import annotations

import click
import pytest

from eap.cli.params import examples
from eap.cli.pd import VariableName, parse_assignment, parse_names


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("mixer",), {"mixer": []}),
        (("mixer", "a", "b"), {"mixer": ["a", "b"]}),
        (("mixer/a", "mixer/b"), {"mixer": ["a", "b"]}),
        (("mixer/a", "oven/a"), {"mixer": ["a"], "oven": ["a"]}),
        (("mixer", "a", "oven/b"), {"mixer": ["a"], "oven": ["b"]}),
        (("mixer", "oven/b"), {"mixer": [], "oven": ["b"]}),
    ],
)
def test_names_of_variables(words: tuple[str, ...], names: dict[str, list[str]]) -> None:
    assert parse_names(words) == names


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("mixer/",), "is not a variable"),
        (("/a",), "is not a variable"),
        (("mixer/a", "b"), "write STATION/b"),
    ],
)
def test_incomplete_names_are_refused(words: tuple[str, ...], reason: str) -> None:
    with pytest.raises(click.UsageError, match=reason):
        parse_names(words)


def test_assignment_in_both_forms() -> None:
    expected = (VariableName("mixer", "a"), "-1")
    assert parse_assignment(("mixer", "a", "-1")) == expected
    assert parse_assignment(("mixer/a", "-1")) == expected
    assert str(expected[0]) == "mixer/a"


@pytest.mark.parametrize(
    "words",
    [("mixer",), ("mixer", "a"), ("mixer/a",), ("mixer/a", "b", "1"), ("mixer", "a", "1", "2")],
)
def test_assignment_that_is_none(words: tuple[str, ...]) -> None:
    with pytest.raises(click.UsageError, match="STATION VAR VALUE"):
        parse_assignment(words)


def test_examples_stay_as_they_are_written():
    command = click.Command("do", epilog=examples("eapctl do this", "eapctl do that"))
    shown = command.get_help(click.Context(command, info_name="do"))
    assert shown.endswith("  Examples:\n    eapctl do this\n    eapctl do that")
