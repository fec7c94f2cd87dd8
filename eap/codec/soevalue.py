"""Values of IDNs between octets and Python, as their attribute says (IEC 61800-7-300)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import TypeAlias

from eap.codec.soe import Display, SoeAttribute, decode_list, encode_list
from eap.codec.wire import Buffer
from eap.errors import MalformedError, TruncatedError

SoeScalar: TypeAlias = int | float
SoeValue: TypeAlias = int | float | str | list[int] | list[float]

_UNSIGNED = "BHIQ"
_SIGNED = "bhiq"
_FLOAT = {2: "f", 3: "d"}


def decode_value(attribute: SoeAttribute, body: Buffer) -> SoeValue:
    """Return a value as element 7 carries it; octets behind it are ignored.

    Raises:
        TruncatedError: the octets end before the value does.
        MalformedError: a list is no whole number of values, or longer than it may be.
    """
    if not attribute.is_list:
        return decode_scalar(attribute, body)
    _, octets = decode_list(body)
    if attribute.display == Display.TEXT:
        return octets.rstrip(b"\0").decode(errors="replace")
    if len(octets) % attribute.size:
        raise MalformedError(
            f"{len(octets)} octets for values of {attribute.size}", layout="SoeAttribute"
        )
    steps = range(0, len(octets), attribute.size)
    values: list[int] | list[float] = [decode_scalar(attribute, octets[at:]) for at in steps]
    return values


def decode_scalar(attribute: SoeAttribute, body: Buffer) -> SoeScalar:
    """Return the one number that *body* begins with; raise TruncatedError if it is too short."""
    if len(body) < attribute.size:
        raise TruncatedError(
            f"{len(body)} octets for a value of {attribute.size}", layout="SoeAttribute"
        )
    number: SoeScalar = struct.unpack_from(_code(attribute), body)[0]
    return number


def encode_value(
    attribute: SoeAttribute,
    value: SoeScalar | str | Sequence[SoeScalar],
    *,
    max_length: int | None = None,
) -> bytes:
    """Return the octets of a value as element 7 carries it.

    *max_length* is what the head of a list says it may grow to, in octets.  A single number is a
    list of one where a list is due.

    Raises:
        ValueError: it is no value of this kind; the message says what is.
    """
    if not attribute.is_list:
        return encode_scalar(attribute, value)
    if isinstance(value, str):
        return encode_list(value.encode(), max_length)
    values = value if isinstance(value, Sequence) else (value,)
    return encode_list(b"".join(encode_scalar(attribute, item) for item in values), max_length)


def encode_scalar(attribute: SoeAttribute, value: object) -> bytes:
    """Return the octets of one number; raise ValueError if it is none that fits."""
    code = _code(attribute)
    try:
        return struct.pack(code, value)
    except (struct.error, OverflowError):
        size = attribute.size
        raise ValueError(
            f"{value!r} is no value of {size} octets: expected {_expected(code, 8 * size)}"
        ) from None


def _expected(code: str, bits: int) -> str:
    if code[-1] in _FLOAT.values():
        return "a number"
    low, high = (0, 2**bits) if code[-1].isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1))
    return f"a whole number from {low} to {high - 1}"


def _code(attribute: SoeAttribute) -> str:
    if attribute.display == Display.FLOAT and attribute.length in _FLOAT:
        return f"<{_FLOAT[attribute.length]}"
    codes = _SIGNED if attribute.display == Display.SIGNED else _UNSIGNED
    return f"<{codes[attribute.length]}"
