"""Little-endian records that read like the tables of the standard.

A record is a frozen :class:`msgspec.Struct` whose annotations give the width of
each field.  The class statement compiles them once into one
:class:`struct.Struct` and two straight-line functions; nothing is interpreted
per frame.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Iterator
from enum import Enum
from typing import Annotated, Any, ClassVar, Self, TypeAlias, get_args, get_origin

import msgspec

from eap.errors import CodecError, MalformedError, TruncatedError
from eap.ids import NetId

Buffer: TypeAlias = bytes | bytearray | memoryview


class Scalar(msgspec.Struct, frozen=True):
    """One field that is a whole number of bytes, optionally wrapped in a value type."""

    code: str
    wrap: type | None = None


class Bits(msgspec.Struct, frozen=True):
    """One field that is part of a word, optionally wrapped; neighbours fill it from bit 0 up."""

    width: int
    wrap: type | None = None


u8 = Annotated[int, Scalar("B")]
u16 = Annotated[int, Scalar("H")]
u32 = Annotated[int, Scalar("I")]
u64 = Annotated[int, Scalar("Q")]
octets16 = Annotated[bytes, Scalar("16s")]
net_id = Annotated[NetId, Scalar("6s", NetId)]
bit = Annotated[int, Bits(1)]
bits2 = Annotated[int, Bits(2)]
bits3 = Annotated[int, Bits(3)]
bits4 = Annotated[int, Bits(4)]
bits6 = Annotated[int, Bits(6)]
bits11 = Annotated[int, Bits(11)]

_WORD_CODE = {8: "B", 16: "H", 32: "I", 64: "Q"}


class WireStruct(msgspec.Struct, frozen=True, gc=False):
    """Base of every fixed-size record."""

    LAYOUT: ClassVar[struct.Struct]
    SIZE: ClassVar[int]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        _compile(cls)

    @classmethod
    def decode(cls, data: Buffer, offset: int = 0) -> Self:
        """Read one record at *offset*.

        Raises TruncatedError if it does not fit and MalformedError if a field
        holds a value that its type does not know.
        """
        raise NotImplementedError  # every subclass gets its own from _compile()

    def encode(self) -> bytes:
        """Return the record's bytes; raise CodecError if a value is out of range."""
        raise NotImplementedError  # every subclass gets its own from _compile()


def _reader(wrap: type | None) -> Callable[[Any], Any] | None:
    """Return a converter to *wrap*; for an enum a look-up, because calling one is slow."""
    if wrap is None or not issubclass(wrap, Enum):
        return wrap
    members = wrap._value2member_map_

    def member_of(value: Any) -> Any:
        try:
            return members[value]
        except KeyError:
            return wrap(value)  # says what is wrong with it

    return member_of


def _kinds_of(cls: type[WireStruct]) -> Iterator[tuple[str, Scalar | Bits]]:
    """Yield name and kind of each field."""
    # typing.get_type_hints returns the same; it took a tenth of a process's start.
    for base in reversed(cls.__mro__):
        scope = vars(sys.modules[base.__module__])
        for name, hint in base.__dict__.get("__annotations__", {}).items():  # noqa: RUF063  inspect is not needed otherwise
            if isinstance(hint, str):
                hint = scope.get(hint) or eval(hint, scope)  # noqa: PLW2901, S307  our own source
            if get_origin(hint) is not ClassVar:
                yield name, get_args(hint)[1]


def _compile(cls: type[WireStruct]) -> None:
    codes: list[str] = []  # one struct code a word
    reads: list[str] = []  # one expression over w0, w1, ... a field
    writes: list[str] = []  # one expression over self a word
    checks: list[str] = []  # true for a value that pack() would cut or pad without a word
    scope: dict[str, Any] = {}
    filled = 0  # bits used of an open word, 0 when none is open

    def close_word() -> None:
        nonlocal filled
        if filled not in _WORD_CODE:
            raise TypeError(f"{cls.__name__}: bit fields stop at bit {filled} of a word")
        codes[-1] = _WORD_CODE[filled]
        filled = 0

    for name, kind in _kinds_of(cls):
        if isinstance(kind, Scalar):
            if filled:
                close_word()
            word = len(codes)
            codes.append(kind.code)
            writes.append(f"self.{name}")
            reads.append(f"w{word}" if kind.wrap is None else f"c{word}(w{word})")
            scope[f"c{word}"] = _reader(kind.wrap)
            if kind.code.endswith("s"):
                checks.append(f"len(self.{name}) != {struct.calcsize(kind.code)}")
        else:
            if not filled:
                codes.append("")
                writes.append("0")
            part = f"w{len(codes) - 1} >> {filled} & {(1 << kind.width) - 1:#x}"
            reads.append(part if kind.wrap is None else f"c_{name}({part})")
            scope[f"c_{name}"] = _reader(kind.wrap)
            writes[-1] += f" | self.{name} << {filled}"
            checks.append(f"self.{name} >> {kind.width}")
            filled += kind.width
    if filled:
        close_word()

    cls.LAYOUT = struct.Struct("<" + "".join(codes))
    cls.SIZE = cls.LAYOUT.size
    words = ", ".join(f"w{n}" for n in range(len(codes)))
    unfit = " or ".join(checks) or "False"
    source = f"""
def decode(cls, data, offset=0):
    try:
        {words}, = unpack(data, offset)
        return cls({", ".join(reads)})
    except error:
        there = max(0, len(data) - offset)
        raise TruncatedError(
            f"needs {{cls.SIZE}} bytes, but {{there}} follow", layout=cls.__name__, offset=offset
        ) from None
    except ValueError as exc:
        raise MalformedError(str(exc), layout=cls.__name__, offset=offset) from None

def encode(self):
    try:
        if {unfit}:
            raise error("a field is too large for its bits or bytes")
        return pack({", ".join(writes)})
    except (error, TypeError) as exc:
        raise CodecError(f"{{exc}} in {{self!r}}", layout=type(self).__name__) from None
"""
    scope |= {
        "unpack": cls.LAYOUT.unpack_from,
        "pack": cls.LAYOUT.pack,
        "error": struct.error,
        "CodecError": CodecError,
        "MalformedError": MalformedError,
        "TruncatedError": TruncatedError,
    }
    exec(source, scope)  # noqa: S102  as dataclasses and attrs do
    cls.decode = classmethod(scope["decode"])  # type: ignore[assignment, method-assign]
    cls.encode = scope["encode"]  # type: ignore[method-assign]
