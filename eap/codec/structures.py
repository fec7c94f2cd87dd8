"""Structs and unions, and their layout.

A struct is laid out as compilers of IEC 61131-3 and C do: a member starts at a multiple of its
alignment, limited by the packing, and the size is a multiple of the largest alignment.  The text of
a struct has all offsets, so a layout that a vendor's file gives is kept as it is.

``NAME<SIZE/ALIGNMENT:MEMBER@OFFSET TYPE,…>`` is the text of a struct: offsets in bytes, ``@3.5``
for bit 5 of byte 3.  A definition that occurs again in the same text is its name alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from eap.codec.basetypes import Boolean, DataType, Plain, Value, check_size
from eap.codec.enumerations import MAX_MEMBERS, check_name
from eap.codec.literals import Literal, read_literal
from eap.codec.wire import Buffer
from eap.suggest import suggest

MAX_DEPTH = 16
"""Levels of nesting of a type."""


class Member(NamedTuple):
    """A member of a struct; *bit_offset* counts from its start."""

    name: str
    kind: DataType
    bit_offset: int

    @property
    def end(self) -> int:
        """Bit behind it."""
        return self.bit_offset + self.kind.bit_length

    @property
    def offset_text(self) -> str:
        """Offset in bytes; of a bit field byte and bit."""
        offset, bit = divmod(self.bit_offset, 8)
        return f"{offset}.{bit}" if self.kind.is_bits else str(offset)


class Structure(DataType, frozen=True, kw_only=True):
    """A struct or union; its value is a dict of its members, in order.

    The members of a union lie at the same place: one of them is written, or several that agree.
    """

    members: tuple[Member, ...]
    align: int
    by_name: Mapping[str, Member]

    @property
    def alignment(self) -> int:
        """Largest alignment of the members, limited by the packing."""
        return self.align

    @property
    def is_union(self) -> bool:
        """True if the members lie at the same place."""
        # One member alone is the same either way.
        return len(self.members) > 1 and all(not each.bit_offset for each in self.members)

    def compose(self, seen: dict[str, DataType]) -> str:
        """Return the name if the definition precedes it, else the definition."""
        if self.alias_of:
            return super().compose(seen)
        if seen.get(self.name) == self:
            return self.name
        text = _structure_text(self.name, self.size, self.align, self.members, seen)
        seen[self.name] = self
        return text

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Read all members."""
        return {name: _decode(kind, buffer, offset, bit) for name, kind, bit in self.members}

    def encode(self, value: Any) -> bytes:
        """Return the bytes of a mapping, dataclass or record, with gaps of zeros.

        Bytes are taken as they are: the memory of a controller.

        Raises:
            ValueError: a member is missing, unknown, or has another type; members of a union
                contradict each other.
        """
        if isinstance(value, bytes) and len(value) == self.size:
            return value
        given = self._given(value)
        if self.is_union:
            return self._encode_union(given)
        missing = [each.name for each in self.members if each.name not in given]
        if missing:
            more = "" if len(missing) < 4 else f" and {len(missing) - 3} more"
            raise ValueError(
                f"a value of {self.name} lacks {', '.join(missing[:3])}{more}: expected all"
                f" members, or one member by its path such as NAME.{missing[0]}"
            )
        octets = bytearray(self.size)
        for member in self.members:
            self._put(octets, member, given[member.name])
        return bytes(octets)

    def parse_text(self, text: str) -> Value:
        """Read ``{member: value, …}``."""
        return self.from_literal(read_literal(text))

    def from_literal(self, literal: Literal) -> Value:
        """Read a mapping of members."""
        return self._converted(literal, lambda kind, each: kind.from_literal(each))

    def from_plain(self, plain: object) -> Value:
        """Read a mapping of members."""
        return self._converted(plain, lambda kind, each: kind.from_plain(each))

    def _converted(self, value: Any, convert: Callable[[DataType, Any], Value]) -> Value:
        given = self._given(value)
        values = {}
        for name, each in given.items():
            try:
                values[name] = convert(self.by_name[name].kind, each)
            except ValueError as exc:
                raise self._in(name, exc) from None
        return self.decode(self.encode(values), 0)

    def to_plain(self, value: Value) -> Plain:
        """Return a mapping of members."""
        given = self._given(value)
        return {name: self.by_name[name].kind.to_plain(each) for name, each in given.items()}

    def completed(self, plain: object) -> Plain:
        """Return a plain value with zeros for the members that *plain* does not name."""
        if not isinstance(plain, Mapping):
            raise self._refuse(plain, f"members such as {{{self.members[0].name}: …}}")
        self._given(plain)
        if self.is_union:
            # Zeros for the other members would contradict the one that is given.
            return dict(plain) if plain else self.to_plain(self.zero)
        return {
            name: complete(kind, plain[name]) if name in plain else kind.to_plain(kind.zero)
            for name, kind, _ in self.members
        }

    def gaps(self) -> Iterator[tuple[int, int]]:
        """Yield the padding between and behind the members: first bit, and number of bits."""
        end = 0
        for member in sorted(self.members, key=lambda each: each.bit_offset):
            if member.bit_offset > end:
                yield end, member.bit_offset - end
            end = max(end, member.end)
        if end < self.bit_length:
            yield end, self.bit_length - end

    def _given(self, value: Any) -> Mapping[str, Any]:
        """Return the members of *value* by name; raise ValueError for a wrong one."""
        if isinstance(value, Mapping):
            given: Mapping[str, Any] = value
        else:
            # Of a dataclass, or of a msgspec record; importing dataclasses would take long.
            fields = getattr(value, "__dataclass_fields__", None)
            fields = fields or getattr(value, "__struct_fields__", None)
            if fields is None or isinstance(value, type):
                raise self._refuse(value, f"members such as {{{self.members[0].name!r}: …}}")
            given = {name: getattr(value, name) for name in fields}
        for name in given:
            if name not in self.by_name:
                known = ", ".join(each.name for each in self.members[:8])
                hint = suggest(str(name), self.by_name) or f"; members: {known}"
                raise ValueError(f"{self.name} has no member {name!r}{hint}")
        return given

    def _put(self, octets: bytearray, member: Member, value: Any) -> None:
        try:
            encoded = member.kind.encode(value)
        except ValueError as exc:
            raise self._in(member.name, exc) from None
        offset, bit = divmod(member.bit_offset, 8)
        if member.kind.is_bits:
            mask = (1 << member.kind.bit_length) - 1 << bit
            octets[offset] = octets[offset] & ~mask | encoded[0] << bit
        else:
            octets[offset : offset + len(encoded)] = encoded

    def _encode_union(self, given: Mapping[str, Any]) -> bytes:
        """Return the bytes of the member that all others given agree with."""
        if not given:
            raise ValueError(f"a value of {self.name} is empty: expected one of its members")
        refused: ValueError | None = None
        for name in given:
            octets = bytearray(self.size)
            try:
                self._put(octets, self.by_name[name], given[name])
            except ValueError as exc:  # such as a number that was read, but has no name
                refused = refused or exc
                continue
            if len(given) == 1 or self._agree(octets, given):
                return bytes(octets)
        if refused:
            raise refused
        raise ValueError(
            f"members of the union {self.name} contradict each other: expected one of"
            f" {', '.join(given)}"
        )

    def _agree(self, octets: bytes | bytearray, given: Mapping[str, Any]) -> bool:
        for name, value in given.items():
            kind = self.by_name[name].kind
            read = _decode(kind, octets, 0, 0)
            if read == value:
                continue
            try:
                # Compared as read again: a name is a number, and a NaN equals nothing.
                again = _decode(kind, kind.encode(value), 0, 0)
            except ValueError:
                return False
            if repr(read) != repr(again):
                return False
        return True

    def _in(self, name: str, exc: ValueError) -> ValueError:
        return ValueError(f"{name} of {self.name}: {exc}")


def _decode(kind: DataType, buffer: Buffer, offset: int, bit_offset: int) -> Value:
    more, bit = divmod(bit_offset, 8)
    if kind.is_bits:
        number = buffer[offset + more] >> bit & (1 << kind.bit_length) - 1
        return kind.decode(bytes((number,)), 0)
    return kind.decode(buffer, offset + more)


def complete(kind: DataType, plain: Any) -> Any:
    """Return *plain* with zeros for the members of structs that it leaves out."""
    return kind.completed(plain) if isinstance(kind, Structure) else plain


def _structure_text(
    name: str, size: int, align: int, members: Iterable[Member], seen: dict[str, DataType]
) -> str:
    listed = ",".join(
        f"{each.name}@{each.offset_text} {each.kind.compose(seen)}" for each in members
    )
    return f"{name}<{size}/{align}:{listed}>"


def make_structure(name: str, members: Sequence[Member], size: int, align: int) -> Structure:
    """Return a struct of a known layout.

    Raises:
        ValueError: a member lies outside, or on another one though not all start at 0; or a name
            occurs twice.
    """
    check_size(name, size)
    if not members:
        raise ValueError(f"{name} has no members: expected at least one")
    if len(members) > MAX_MEMBERS:
        raise ValueError(f"{name} has {len(members)} members, at most {MAX_MEMBERS}")
    if align not in {1, 2, 4, 8} or size % align:
        raise ValueError(f"{name} has {size} bytes, which is no multiple of its alignment {align}")
    by_name: dict[str, Member] = {}
    for each in members:
        check_name(name, each.name)
        if each.name in by_name:
            raise ValueError(f"{name} has two members {each.name}")
        _check_place(name, each, size)
        by_name[each.name] = each
    if any(each.bit_offset for each in members):
        _check_overlaps(name, members)
    return Structure(
        _structure_text(name, size, align, members, {}),
        # OCTET_STRING: SDO information has no code for a struct.
        0x0A,
        8 * size,
        size,
        name=name,
        members=tuple(members),
        align=align,
        by_name=by_name,
    )


def _check_place(name: str, member: Member, size: int) -> None:
    where = f"{member.name} of {name} at {member.offset_text}"
    if member.bit_offset < 0 or member.end > 8 * size:
        raise ValueError(f"{where} ends behind the {size} bytes of {name}")
    if member.kind.is_bits:
        if member.bit_offset % 8 + member.kind.bit_length > 8:
            raise ValueError(f"{where} has bits of two bytes")
    elif member.bit_offset % 8:
        raise ValueError(f"{where} does not start on a whole byte")
    # BOOL is one bit in a PD (ETG.1005).  A struct is the memory of a controller, where a BOOL has
    # a byte: its text must say which one is meant.
    if isinstance(member.kind, Boolean) and member.kind.is_bits:
        raise ValueError(f"{where} is a lone bit: expected BOOL8 or BIT")


def _check_overlaps(name: str, members: Iterable[Member]) -> None:
    last: Member | None = None
    for each in sorted(members, key=lambda each: each.bit_offset):
        if last is not None and each.bit_offset < last.end:
            raise ValueError(
                f"{each.name} of {name} lies on {last.name}: expected members behind each other,"
                " or all of them at 0 as in a union"
            )
        if last is None or each.end > last.end:
            last = each


def lay_out_structure(
    name: str,
    members: Sequence[tuple[str, DataType]],
    *,
    pack: int = 8,
    base: Structure | None = None,
    union: bool = False,
) -> Structure:
    """Return a struct as a compiler lays it out; a struct that extends *base* begins with it.

    Bit fields share a byte as long as they fit.

    Raises:
        ValueError: as of :func:`make_structure`.
    """
    placed = list(base.members) if base else []
    end = base.bit_length if base else 0
    align = base.align if base else 1
    largest = end
    for member, kind in members:
        if union:
            end = 0
        if kind.is_bits:
            if end % 8 + kind.bit_length > 8:
                end += -end % 8
        else:
            step = 8 * min(kind.alignment, pack)
            end += -end % step
            align = max(align, step // 8)
        placed.append(Member(member, kind, end))
        end += kind.bit_length
        largest = max(largest, end)
    size = -(-largest // 8)
    # Padded at the end, so that the next element of an array is aligned, too.
    return make_structure(name, placed, size + -size % align, align)


def place_structure(
    name: str, members: Sequence[Member], *, size: int | None = None, pack: int = 8
) -> Structure:
    """Return a struct whose members lie where a vendor's file or its user says.

    Raises:
        ValueError: as of :func:`make_structure`.
    """
    end = max((each.end for each in members), default=0)
    align = max((min(each.kind.alignment, pack) for each in members), default=1)
    size = -(-end // 8) if size is None else size
    # A layout of another compiler's may be aligned less.
    while align > 1 and (size % align or any(_is_off(each, align) for each in members)):
        align //= 2
    return make_structure(name, members, size, align)


def _is_off(member: Member, align: int) -> bool:
    return not member.kind.is_bits and bool(
        member.bit_offset % (8 * min(member.kind.alignment, align))
    )


def member_type_name(kind: DataType) -> str:
    """Return the name of a member's type: every BOOL of a struct has a byte, as a BOOL8 has."""
    return "BOOL" if kind.name == "BOOL8" else kind.name
