"""Values of arrays and structs as typed on a command line: brackets, braces and commas.

``1, 2, 3``, ``[[1, 2], [3, 4]]``, ``{position: 5, state: On}``; a text with a comma or bracket in
it is quoted.  JSON of such a value is read as well.
"""

from __future__ import annotations

import re
from typing import Any, TypeAlias

import msgspec

Literal: TypeAlias = "str | list[Literal] | dict[str, Literal]"
"""Parts of a value: single ones are texts, for the type to read."""

# The reader calls itself: text of brackets only must not exhaust the stack.
MAX_DEPTH = 32
_SPACE = re.compile(r"\s*")
_QUOTED = re.compile(r""""((?:[^"\\]|\\.)*)"|'((?:[^']|'')*)'""", re.DOTALL)
_ESCAPE = re.compile(r"\\(u[0-9a-fA-F]{4}|.)", re.DOTALL)
_CONTROLS = {"n": "\n", "t": "\t", "r": "\r", "b": "\b", "f": "\f"}
_SIGNS = re.compile(r"""[,\[\]{}"']""")
_VALUE = re.compile(r"[^,\[\]{}]*")
_NAME = re.compile(r"[^,\[\]{}:=]*")


def read_literal(text: str) -> Literal:
    """Return the parts of *text*; one with commas outside of brackets is a list.

    Raises:
        ValueError: brackets or quotes do not match, or are nested too deeply.
    """
    reader = _LiteralReader(text)
    parts = [reader.value(0)]
    while reader.take(","):
        parts.append(reader.value(0))
    reader.end()
    return parts[0] if len(parts) == 1 else parts


def write_literal(plain: Any) -> str:
    """Return a value of YAML or JSON as :func:`read_literal` reads it."""
    if isinstance(plain, list):
        return f"[{', '.join(map(write_literal, plain))}]"
    if isinstance(plain, dict):
        return f"{{{', '.join(f'{name}: {write_literal(each)}' for name, each in plain.items())}}}"
    if isinstance(plain, bool):
        return "true" if plain else "false"
    return _quoted(plain) if isinstance(plain, str) else str(plain)


def _quoted(text: str) -> str:
    """Return *text* with quotes where it needs them."""
    if text and text.isprintable() and text == text.strip() and not _SIGNS.search(text):
        return text
    # Only double quotes know escapes: a raw line break would not survive a shell.
    if not text.isprintable():
        return msgspec.json.encode(text).decode()
    return "'" + text.replace("'", "''") + "'"


class _LiteralReader:
    """Position in a text."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0

    def take(self, sign: str) -> bool:
        """Skip *sign* if it comes next; return whether it did."""
        self._skip()
        if not self._text.startswith(sign, self._at):
            return False
        self._at += len(sign)
        return True

    def end(self) -> None:
        """Raise ValueError if something is left."""
        self._skip()
        if self._at < len(self._text):
            raise self._error("a comma or the end")

    def value(self, depth: int) -> Literal:
        """Read one value."""
        if depth > MAX_DEPTH:
            raise ValueError(f"a value is nested too deeply: expected at most {MAX_DEPTH} levels")
        if self.take("["):
            return self._items(depth)
        if self.take("{"):
            return self._members(depth)
        return self._single(_VALUE)

    def _items(self, depth: int) -> Literal:
        items: list[Literal] = []
        while not self.take("]"):
            if items and not self.take(","):
                raise self._error("a comma or ]")
            items.append(self.value(depth + 1))
        return items

    def _members(self, depth: int) -> Literal:
        members: dict[str, Literal] = {}
        while not self.take("}"):
            if members and not self.take(","):
                raise self._error("a comma or }")
            name = self._single(_NAME)
            # One of the two is a slip of typing, and nothing says which.
            if name in members:
                raise ValueError(f"member {name!r} is given twice: expected each once")
            if not (self.take(":") or self.take("=")):
                raise self._error("a colon behind the name of a member")
            members[name] = self.value(depth + 1)
        return members

    def _single(self, plain: re.Pattern[str]) -> str:
        self._skip()
        if match := _QUOTED.match(self._text, self._at):
            self._at = match.end()
            if match[1] is None:
                return match[2].replace("''", "'")
            return _ESCAPE.sub(_unescape, match[1])
        match = plain.match(self._text, self._at)
        self._at = match.end() if match else self._at
        return match[0].rstrip() if match else ""

    def _skip(self) -> None:
        if match := _SPACE.match(self._text, self._at):
            self._at = match.end()

    def _error(self, expected: str) -> ValueError:
        rest = self._text[self._at :][:20] or "the end"
        return ValueError(f"{rest!r} at character {self._at + 1} of a value: expected {expected}")


def _unescape(match: re.Match[str]) -> str:
    sign = match[1]
    return chr(int(sign[1:], 16)) if len(sign) == 5 else _CONTROLS.get(sign, sign)
