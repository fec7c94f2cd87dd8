"""Numbers, flags and bytes of ESI elements; faults are collected with their lines.

Numbers are ``#x1A`` (HexDec) or decimal with a sign, and files have white space and line ends
within them.
"""

from __future__ import annotations

from typing import NamedTuple

from eap.codec.xmlstream import XmlElement, parse_integer

MAX_FINDINGS = 200
"""Findings kept of one file."""
_SHOWN = 40
_TRUE = frozenset(("1", "true"))
# Language identifiers of Windows: the United States and the United Kingdom.
_ENGLISH = frozenset(("1033", "2057"))
_EXPECTED = "a number such as #x1A00 or 6656"


class EsiFinding(NamedTuple):
    """Fault of a file; *line* is 0 for the file as a whole."""

    line: int
    message: str
    expected: str


class Fields:
    """Reader of fields.

    Attributes:
        findings: Faults, in the order of the file.
    """

    def __init__(self) -> None:
        self.findings: list[EsiFinding] = []

    def report(self, line: int, message: str, expected: str) -> None:
        """Add a finding; more than a file can need are dropped."""
        if len(self.findings) < MAX_FINDINGS:
            self.findings.append(EsiFinding(line, message, expected))

    def number(
        self, text: str, line: int, name: str, *, bits: int = 32, is_signed: bool = False
    ) -> int:
        """Return a number of at most *bits* bits; 0 and a finding if it is none."""
        value = parse_integer(text)
        if value is None:
            self.report(line, f"{name} is {_short(text)}", _EXPECTED)
            return 0
        low, high = (-(1 << bits - 1), (1 << bits) - 1) if is_signed else (0, (1 << bits) - 1)
        if not low <= value <= high:
            self.report(line, f"{name} is {_short(text)}", f"a number from {low} to {high}")
            return 0
        return value

    def child(
        self,
        parent: XmlElement,
        path: str,
        *,
        bits: int = 32,
        is_signed: bool = False,
        default: int = 0,
    ) -> int:
        """Return the number at *path*, *default* if there is none."""
        found = parent.find(path)
        if found is None or not found.text:
            return default
        return self.number(found.text, found.line, path, bits=bits, is_signed=is_signed)

    def optional_child(self, parent: XmlElement, path: str, *, bits: int = 32) -> int | None:
        """Return the number at *path*, None if there is none."""
        found = parent.find(path)
        if found is None or not found.text:
            return None
        return self.number(found.text, found.line, path, bits=bits)

    def attribute(self, element: XmlElement, name: str, *, bits: int = 32, default: int = 0) -> int:
        """Return the number of an attribute, *default* without it."""
        text = element.get(name)
        if not text:
            return default
        return self.number(text, element.line, f"{element.tag} {name}", bits=bits)

    def optional_attribute(self, element: XmlElement, name: str, *, bits: int = 32) -> int | None:
        """Return the number of an attribute, None without it."""
        text = element.get(name)
        if not text:
            return None
        return self.number(text, element.line, f"{element.tag} {name}", bits=bits)

    def octets(self, element: XmlElement | None, name: str) -> bytes:
        """Return bytes in hexadecimal digits; empty and a finding if they are none."""
        if element is None:
            return b""
        try:
            return bytes.fromhex("".join(element.text.split()))
        except ValueError:
            self.report(
                element.line, f"{name} is {_short(element.text)}", "pairs of hexadecimal digits"
            )
            return b""


def flag(element: XmlElement, name: str) -> bool:
    """Return a Boolean attribute."""
    return is_true(element.get(name))


def is_true(text: str) -> bool:
    """Return true for 1 and true, the texts of an XML Boolean."""
    return text.lower() in _TRUE


def english(element: XmlElement, tag: str = "Name") -> str:
    """Return the English text of the children *tag*, else that of the first one."""
    found = list(element.iterfind(tag))
    chosen = next((each for each in found if each.get("LcId") in _ENGLISH), None)
    if chosen is None:
        chosen = found[0] if found else None
    return "" if chosen is None else " ".join(chosen.text.split())


def _short(text: str) -> str:
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…")
