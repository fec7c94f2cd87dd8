from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.literals import read_literal, write_literal


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("5", "5"),
        (" a b ", "a b"),
        ("1, 2,3", ["1", "2", "3"]),
        ("[1, [2, 3]]", ["1", ["2", "3"]]),
        ("[]", []),
        ("{a: 1, b = {c: x y}}", {"a": "1", "b": {"c": "x y"}}),
        ("{}", {}),
        ("{t: TOD#12:30:15}", {"t": "TOD#12:30:15"}),
        ("'it''s, so'", "it's, so"),
        ('"a\\n\\u00e4\\"b"', 'a\nä"b'),
        ("{'a': 1}", {"a": "1"}),
        ("1,,2", ["1", "", "2"]),
        ("", ""),
    ],
)
def test_literal_is_divided(text: str, parts: Any) -> None:
    assert read_literal(text) == parts


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[1", "'the end' at character 3 of a value: expected a comma or ]"),
        ("]", "']' at character 1 of a value: expected a comma or the end"),
        ("{a: 1} 2", "'2' at character 8"),
        ("[1 [2]]", "expected a comma or ]"),
        ("{a: {b: 1} c: 2}", "expected a comma or }"),
        ("{: 1, : 2}", "member '' is given twice"),
        ("[" * 100, "nested too deeply: expected at most 32 levels"),
        ("{a:" * 100, "nested too deeply"),
    ],
)
def test_wrong_literal_says_where(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason.replace("[", "\\[").replace("{", "\\{")):
        read_literal(text)


def texts(plain: Any) -> Any:
    if isinstance(plain, list):
        return [texts(each) for each in plain]
    if isinstance(plain, dict):
        return {name: texts(each) for name, each in plain.items()}
    return str(plain).lower() if isinstance(plain, bool) else str(plain)


names = st.from_regex(r"\A[a-z]+\Z")
plains = st.recursive(
    st.booleans() | st.integers() | st.text(st.characters(exclude_categories=["Cs"]), max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3),
    max_leaves=10,
)


@given(plains)
def test_written_literal_is_read_again(plain: Any) -> None:
    literal = write_literal(plain)
    assert read_literal(literal) == texts(plain)
    assert "\n" not in literal


@given(st.text("[]{},:='\"\\ a1\n", max_size=30))
def test_any_text_is_a_literal_or_refused(text: str) -> None:
    try:
        read_literal(text)
    except ValueError:
        return
