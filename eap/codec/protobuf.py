"""Wire format of protobuf: fields with tags, as protocolbuffers' "Encoding" page describes it."""

from __future__ import annotations

from collections.abc import Iterator

from eap.errors import MalformedError, TruncatedError

VARINT, FIXED64, LENGTH, FIXED32 = 0, 1, 2, 5
"""Wire types; the groups of old schemas (3, 4) are not supported."""
_FIXED = {FIXED64: 8, FIXED32: 4}
_MAX_VARINT = 10


def varint(number: int) -> bytes:
    """Return *number* in groups of seven bits, the lowest first."""
    octets = bytearray()
    while number > 0x7F:
        octets.append(number & 0x7F | 0x80)
        number >>= 7
    octets.append(number)
    return bytes(octets)


def encode_tag(number: int, wire: int) -> bytes:
    """Return the tag of the field *number*."""
    return varint(number << 3 | wire)


def encode_field(number: int, content: bytes | str | int) -> bytes:
    """Return a field of a number, a text, or the bytes of a message."""
    if isinstance(content, int):
        return encode_tag(number, VARINT) + varint(content)
    octets = content.encode() if isinstance(content, str) else content
    return encode_tag(number, LENGTH) + varint(len(octets)) + octets


def iter_fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yield number and content of each field: an int, or the bytes of any other content.

    Raises:
        TruncatedError: the data ends within a field.
        MalformedError: a number is too long, or a field has a wire type that does not exist.
    """
    offset = 0
    while offset < len(data):
        key, offset = _read_varint(data, offset)
        number, wire = key >> 3, key & 7
        if wire == VARINT:
            value, offset = _read_varint(data, offset)
            yield number, value
            continue
        if wire == LENGTH:
            size, offset = _read_varint(data, offset)
        elif wire in _FIXED:
            size = _FIXED[wire]
        else:
            raise MalformedError(
                f"unknown wire type {wire}", layout=f"protobuf field {number}", offset=offset
            )
        end = offset + size
        if end > len(data):
            raise TruncatedError(
                f"{size} bytes expected", layout=f"protobuf field {number}", offset=offset
            )
        yield number, data[offset:end]
        offset = end


def _read_varint(data: bytes, offset: int) -> tuple[int, int]:
    value = 0
    # 64 bits in groups of seven; more would make a number of any length.
    for position in range(_MAX_VARINT):
        if offset + position >= len(data):
            raise TruncatedError("the data ends within it", layout="protobuf number", offset=offset)
        octet = data[offset + position]
        value |= (octet & 0x7F) << 7 * position
        if octet < 0x80:
            return value & 0xFFFF_FFFF_FFFF_FFFF, offset + position + 1
    raise MalformedError("more than 10 bytes", layout="protobuf number", offset=offset)
