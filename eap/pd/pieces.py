"""JSON of long records, made and read in short steps.

A call into msgspec keeps the interpreter until it is done, which is milliseconds for thousands of
records.  Where cycles run beside it, it is given some of them at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any, TypeVar

import msgspec

PIECE = 64
"""Records in one step: about 50 us."""

T = TypeVar("T", bound=msgspec.Struct)


def encode(record: msgspec.Struct) -> bytes:
    """Return *record* as JSON."""
    fields = []
    for name in record.__struct_fields__:
        value = getattr(record, name)
        if isinstance(value, tuple):
            pieces = (msgspec.json.encode(piece)[1:-1] for piece in _pieces(value))
            octets = b"[" + b",".join(pieces) + b"]"
        else:
            octets = msgspec.json.encode(value)
        fields.append(msgspec.json.encode(name) + b":" + octets)
    return b"{" + b",".join(fields) + b"}"


def to_lines(record: msgspec.Struct) -> bytes:
    """Return *record* in lines for :func:`from_lines`: the first without what may be long."""
    long = {
        name: value
        for name in record.__struct_fields__
        if isinstance(value := getattr(record, name), tuple)
    }
    lines = [msgspec.json.encode(msgspec.structs.replace(record, **dict.fromkeys(long, ())))]
    for name, value in long.items():
        lines += [name.encode() + b" " + msgspec.json.encode(piece) for piece in _pieces(value)]
    return b"\n".join(lines)


def from_lines(data: bytes, kind: type[T]) -> T:
    """Read what :func:`to_lines` made; raise msgspec.MsgspecError or KeyError for anything else."""
    first, *rest = data.split(b"\n")
    record = msgspec.json.decode(first, type=kind)
    decoders = _decoders(kind)
    long: dict[str, list[Any]] = {}
    for line in rest:
        name, _, octets = line.partition(b" ")
        long.setdefault(name.decode(), []).extend(decoders[name.decode()].decode(octets))
    return msgspec.structs.replace(record, **{name: tuple(value) for name, value in long.items()})


def _pieces(value: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    return (value[at : at + PIECE] for at in range(0, len(value), PIECE))


@lru_cache(maxsize=8)
def _decoders(kind: type[msgspec.Struct]) -> dict[str, msgspec.json.Decoder[Any]]:
    return {field.name: msgspec.json.Decoder(field.type) for field in msgspec.structs.fields(kind)}
