"""Conditions over named values, such as ``island-03/temp>80 or lost``.

    condition   = both, {"or", both}
    both        = negation, {"and", negation}
    negation    = "not", negation | comparison
    comparison  = operand, [("==" | "=" | "!=" | "<=" | "<" | ">=" | ">"), operand]
    operand     = name | number | "true" | "false" | 'text' | "text" | "(", condition, ")"

A name has letters, digits, ``_ - . / [ ]`` and begins with a letter or ``_``; there is no
arithmetic, so ``-`` is a part of a name.  An operand alone is true if it is neither 0 nor empty.
Comparisons with a value that is unknown, or of another kind, are false; ``!=`` is true for values
of different kinds.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

MAX_LENGTH = 1000
_MAX_DEPTH = 50
_TOKEN = re.compile(
    r"\s*(?:(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?![\w.]))"
    r"|(?P<name>[^\W\d][\w./\[\]-]*)"
    r"|(?P<text>'[^']*'|\"[^\"]*\")"
    r"|(?P<sign>==|!=|<=|>=|[=<>()])"
    r"|(?P<rest>\S))"
)
_EXAMPLE = 'expected for example "island-03/temp>80 or lost"'
_COMPARE: Mapping[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq,
    "=": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_CONSTANTS = {"true": True, "false": False}
_WORDS = {"or", "and", "not"}

Evaluator: TypeAlias = Callable[[Sequence[Any]], Any]
"""Function of the values of all names of an expression."""


class Condition:
    """A condition that was parsed.

    Args:
        text: In the grammar above.

    Attributes:
        text: The same.
        names: The names in it, each once.

    Raises:
        ValueError: *text* is none; the message says where and names an example.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        parser = _ConditionParser(text)
        self._evaluate = parser.parse()
        self.names = tuple(parser.names)

    def is_true(self, values: Sequence[Any]) -> bool:
        """Return whether it holds for *values*, those of :attr:`names` in their order.

        An unknown value is None.
        """
        return bool(self._evaluate(values))


class _ConditionParser:
    def __init__(self, text: str) -> None:
        self._text = text
        if len(text) > MAX_LENGTH:
            raise self._error(f"it has {len(text)} characters, {MAX_LENGTH} at most")
        self._tokens = [
            (match.lastgroup or "", match.group(match.lastgroup or 0), match.end())
            for match in _TOKEN.finditer(text)
        ]
        self._at = 0
        self._depth = 0
        self.names: list[str] = []

    def parse(self) -> Evaluator:
        """Return the function of the whole text."""
        found = self._condition()
        if self._at < len(self._tokens):
            raise self._error(f"{self._tokens[self._at][1]!r} is not expected there")
        return found

    def _condition(self) -> Evaluator:
        parts = [self._both()]
        while self._takes("or"):
            parts.append(self._both())
        return parts[0] if len(parts) == 1 else lambda v: any(part(v) for part in parts)

    def _both(self) -> Evaluator:
        parts = [self._negation()]
        while self._takes("and"):
            parts.append(self._negation())
        return parts[0] if len(parts) == 1 else lambda v: all(part(v) for part in parts)

    def _negation(self) -> Evaluator:
        if not self._takes("not"):
            return self._comparison()
        self._enter()
        inner = self._negation()
        self._depth -= 1
        return lambda v: not inner(v)

    def _comparison(self) -> Evaluator:
        left = self._operand()
        if self._at >= len(self._tokens) or self._tokens[self._at][1] not in _COMPARE:
            return left
        compare = _COMPARE[self._tokens[self._at][1]]
        self._at += 1
        right = self._operand()
        return lambda v: _holds(compare, left(v), right(v))

    def _operand(self) -> Evaluator:
        if self._at >= len(self._tokens):
            raise self._error("it ends where a name or a value is expected")
        kind, word, _ = self._tokens[self._at]
        self._at += 1
        if word == "(":
            self._enter()
            inner = self._condition()
            self._depth -= 1
            if not self._takes(")"):
                raise self._error("a ')' is missing")
            return inner
        if kind == "number":
            number = float(word) if any(each in word for each in ".eE") else int(word)
            return lambda _: number
        if kind == "text":
            return lambda _: word[1:-1]
        if kind != "name" or word in _WORDS:
            raise self._error(f"{word!r} stands where a name or a value is expected")
        if word in _CONSTANTS:
            return lambda _: _CONSTANTS[word]
        if word not in self.names:
            self.names.append(word)
        return operator.itemgetter(self.names.index(word))

    def _takes(self, token: str) -> bool:
        if self._at < len(self._tokens) and self._tokens[self._at][1] == token:
            self._at += 1
            return True
        return False

    def _enter(self) -> None:
        self._depth += 1
        # The parser and the function call themselves for each.
        if self._depth > _MAX_DEPTH:
            raise self._error(f"it is nested deeper than {_MAX_DEPTH}")

    def _error(self, problem: str) -> ValueError:
        return ValueError(f"condition {self._text[:100]!r}: {problem}; {_EXAMPLE}")


def _holds(compare: Callable[[Any, Any], bool], left: Any, right: Any) -> bool:
    if left is None or right is None:
        return False
    try:
        return compare(left, right)
    except TypeError:  # a text and a number have no order
        return False
