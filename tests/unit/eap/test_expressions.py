"""Conditions over named values."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.expressions import MAX_LENGTH, Condition


def holds(text, **values):
    condition = Condition(text)
    known = {name.replace("_SL_", "/").replace("_", "-"): each for name, each in values.items()}
    return condition.is_true([known.get(name) for name in condition.names])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("island-03/temp>80 or lost", False),
        ("island-03/temp>=80", True),
        ("island-03/temp > -80.5 and not lost", True),
        ("lost or late", True),
        ("lost=0", True),
        ("lost == 0 and late != 0", True),
        ("not (lost or late)", False),
        ("not lost and not late", False),
        ("late and late<4 or lost", True),
        ("(lost or late) and lost", False),
        ("mode=='auto'", True),
        ('mode != "auto"', False),
        ("is-on == true", True),
        ("is-on and mode", True),
        ("island-03/temp", True),
        ("1e3 > 999", True),
        ("80<=island-03/temp", True),
    ],
)
def test_condition_is_evaluated_as_it_reads(text, expected):
    assert holds(text, island_03_SL_temp=80, lost=0, late=3, mode="auto", is_on=True) is expected


def test_condition_names_each_value_once():
    assert Condition("a/x.y[2]>1 or lost or a/x.y[2]<0").names == ("a/x.y[2]", "lost")


@pytest.mark.parametrize("text", ["gone>1", "gone<1", "gone==0", "gone", "mode>1", "mode==1"])
def test_condition_is_false_for_what_is_unknown_or_of_another_kind(text):
    assert holds(text, mode="auto" if "mode" in text else None) is False


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "it ends where a name"),
        ("lost >", "it ends where a name"),
        ("lost late", "'late' is not expected"),
        ("1 < lost < 3", "'<' is not expected"),
        ("(lost", r"a '\)' is missing"),
        ("lost)", r"'\)' is not expected"),
        ("or lost", "'or' stands where"),
        ("lost; rm", "';' is not expected"),
        ("__import__('os')", r"'\(' is not expected"),
        ("lost + 1", r"'\+' is not expected"),
        ("80temp", "'8' stands where"),
        ("(" * 60 + "lost" + ")" * 60, "nested deeper"),
        ("not " * 60 + "lost", "nested deeper"),
        ("a or " * MAX_LENGTH, "characters"),
    ],
)
def test_condition_that_is_none_is_refused_with_an_example(text, problem):
    with pytest.raises(ValueError, match=problem) as caught:
        Condition(text)
    assert "island-03/temp>80 or lost" in str(caught.value)


@given(st.text(alphabet="ab/1.-<>=!()'\" ornotd", max_size=40))
def test_any_text_is_a_condition_or_refused(text):
    try:
        condition = Condition(text)
    except ValueError as exc:
        assert "condition" in str(exc)  # noqa: PT017  nothing else may be raised
    else:
        assert condition.is_true([None] * len(condition.names)) in {True, False}
