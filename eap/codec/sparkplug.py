"""Payloads of Sparkplug B: metrics with their types (``sparkplug_b.proto`` of Eclipse Tahu).

A metric has a name, in a birth also an alias; data names it by the alias alone.  Integers are
unsigned in the format: negative ones are their two's complement with 32 or 64 bits.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
from typing import Any, NamedTuple, TypeAlias

from eap.codec.protobuf import FIXED32, FIXED64, encode_field, encode_tag, iter_fields
from eap.errors import MalformedError

MAX_METRICS = 10_000
"""Metrics of a payload that is decoded, those in templates included."""
_MAX_DEPTH = 16
_LAYOUT = "Sparkplug payload"


class MetricType(IntEnum):
    """Data types of metrics, of columns and of properties."""

    INT8 = 1
    INT16 = 2
    INT32 = 3
    INT64 = 4
    UINT8 = 5
    UINT16 = 6
    UINT32 = 7
    UINT64 = 8
    FLOAT = 9
    DOUBLE = 10
    BOOLEAN = 11
    STRING = 12
    DATE_TIME = 13
    TEXT = 14
    UUID = 15
    DATA_SET = 16
    BYTES = 17
    FILE = 18
    TEMPLATE = 19


class DataSet(NamedTuple):
    """Table of values."""

    columns: Sequence[str]
    types: Sequence[MetricType]
    rows: Sequence[Sequence[Any]]


class Template(NamedTuple):
    """Struct, or with *is_definition* its type; *reference* names the type of a value."""

    metrics: Sequence[Metric]
    reference: str = ""
    is_definition: bool = False


class Metric(NamedTuple):
    """One value.

    Attributes:
        name: Empty where the alias alone names it.
        kind: None in a decoded metric that has no type.
        value: bool, int, float, str, bytes, DataSet or Template; None for null.  A decoded int is
            unsigned where the metric has no type.
        alias: None without one.
        time_ms: Unix time; None for that of the payload.
        properties: Such as ``Quality``; int, float, bool or str.
    """

    name: str
    kind: MetricType | None
    value: Any
    alias: int | None = None
    time_ms: int | None = None
    properties: Sequence[tuple[str, int | float | bool | str]] = ()


class SparkplugPayload(NamedTuple):
    """Decoded payload; *time_ms* and *seq* are None where it has none."""

    time_ms: int | None
    seq: int | None
    metrics: list[Metric]


_INT, _LONG, _FLOAT, _DOUBLE, _BOOL, _STRING, _BYTES, _DATA_SET, _TEMPLATE = range(9)
_SHAPES = {
    **dict.fromkeys((MetricType.INT8, MetricType.INT16, MetricType.INT32), _INT),
    **dict.fromkeys((MetricType.UINT8, MetricType.UINT16), _INT),
    # UInt32 as Tahu sends it: its decoders look for nothing else, ours takes both.
    **dict.fromkeys(
        (MetricType.UINT32, MetricType.INT64, MetricType.UINT64, MetricType.DATE_TIME), _LONG
    ),
    MetricType.FLOAT: _FLOAT,
    MetricType.DOUBLE: _DOUBLE,
    MetricType.BOOLEAN: _BOOL,
    **dict.fromkeys((MetricType.STRING, MetricType.TEXT, MetricType.UUID), _STRING),
    **dict.fromkeys((MetricType.BYTES, MetricType.FILE), _BYTES),
    MetricType.DATA_SET: _DATA_SET,
    MetricType.TEMPLATE: _TEMPLATE,
}
_METRIC_VALUE, _SET_VALUE, _PROPERTY_VALUE = 10, 1, 3
"""Number of ``int_value`` in a metric, in a row of a data set, and in a property."""
_SIGNED_BITS = {
    MetricType.INT8: 8,
    MetricType.INT16: 16,
    MetricType.INT32: 32,
    MetricType.INT64: 64,
}

_FLOAT_LAYOUT, _DOUBLE_LAYOUT = struct.Struct("<f"), struct.Struct("<d")
_Encoder: TypeAlias = Callable[[int, Any], bytes]


def _encode_float(number: int, value: float) -> bytes:
    try:
        octets = _FLOAT_LAYOUT.pack(value)
    except OverflowError:
        # As processors convert it: a value that is too large must not hold back the others.
        octets = _FLOAT_LAYOUT.pack(float("inf") if value > 0 else float("-inf"))
    return encode_tag(number, FIXED32) + octets


_ENCODERS: tuple[_Encoder, ...] = (
    lambda number, value: encode_field(number, value & 0xFFFF_FFFF),
    lambda number, value: encode_field(number, value & 0xFFFF_FFFF_FFFF_FFFF),
    _encode_float,
    lambda number, value: encode_tag(number, FIXED64) + _DOUBLE_LAYOUT.pack(value),
    lambda number, value: encode_field(number, int(value)),
    encode_field,
    encode_field,
    lambda number, value: encode_field(number, _encode_data_set(value)),
    lambda number, value: encode_field(number, _encode_template(value)),
)


def encode_payload(time_ms: int, metrics: Iterable[Metric], seq: int | None) -> bytes:
    """Return the bytes of a message; *seq* is None for a last will."""
    parts = [encode_field(1, time_ms)]
    parts += (encode_field(2, _encode_metric(each)) for each in metrics)
    if seq is not None:
        parts.append(encode_field(3, seq))
    return b"".join(parts)


def _encode_metric(metric: Metric) -> bytes:
    parts = []
    if metric.name:
        parts.append(encode_field(1, metric.name))
    if metric.alias is not None:
        parts.append(encode_field(2, metric.alias))
    if metric.time_ms is not None:
        parts.append(encode_field(3, metric.time_ms))
    if metric.kind is not None:
        parts.append(encode_field(4, metric.kind))
    if metric.value is None:
        parts.append(encode_field(7, 1))
    if metric.properties:
        parts.append(encode_field(9, _encode_properties(metric.properties)))
    if metric.value is not None and metric.kind is not None:
        parts.append(_encode_value(_METRIC_VALUE, metric.kind, metric.value))
    return b"".join(parts)


def _encode_value(first: int, kind: MetricType, value: Any) -> bytes:
    shape = _SHAPES[kind]
    return _ENCODERS[shape](first + shape, value)


def _encode_properties(properties: Iterable[tuple[str, int | float | bool | str]]) -> bytes:
    keys, values = [], []
    for key, value in properties:
        kind = _PROPERTY_TYPES[type(value)]
        keys.append(encode_field(1, key))
        values.append(
            encode_field(2, encode_field(1, kind) + _encode_value(_PROPERTY_VALUE, kind, value))
        )
    return b"".join(keys + values)


_PROPERTY_TYPES = {
    int: MetricType.INT32,
    float: MetricType.DOUBLE,
    bool: MetricType.BOOLEAN,
    str: MetricType.STRING,
}


def _encode_data_set(value: DataSet) -> bytes:
    parts = [encode_field(1, len(value.columns))]
    parts += (encode_field(2, name) for name in value.columns)
    parts += (encode_field(3, kind) for kind in value.types)
    for row in value.rows:
        elements = (
            encode_field(1, b"" if each is None else _encode_value(_SET_VALUE, kind, each))
            for kind, each in zip(value.types, row, strict=True)
        )
        parts.append(encode_field(4, b"".join(elements)))
    return b"".join(parts)


def _encode_template(value: Template) -> bytes:
    parts = [encode_field(2, _encode_metric(each)) for each in value.metrics]
    if value.reference:
        parts.append(encode_field(4, value.reference))
    parts.append(encode_field(5, int(value.is_definition)))
    return b"".join(parts)


def decode_payload(data: bytes) -> SparkplugPayload:
    """Read a message.

    Raises:
        CodecError: it is none, or has too many metrics.
    """
    time_ms = seq = None
    metrics = []
    room = [MAX_METRICS]
    for number, content in iter_fields(data):
        if number == 1:
            time_ms = _number(content)
        elif number == 2:
            metrics.append(_decode_metric(_octets(content), room, _MAX_DEPTH))
        elif number == 3:
            seq = _number(content)
    return SparkplugPayload(time_ms, seq, metrics)


def _decode_metric(data: bytes, room: list[int], depth: int) -> Metric:
    # A list, so that the metrics in templates count, too.
    room[0] -= 1
    if room[0] < 0 or not depth:
        raise MalformedError(f"more than {MAX_METRICS} metrics, or nested too deep", layout=_LAYOUT)
    name, alias, time_ms, kind, value = "", None, None, None, None
    raw: tuple[int, int | bytes] | None = None
    for number, content in iter_fields(data):
        if number == 1:
            name = _text(content)
        elif number == 2:
            alias = _number(content)
        elif number == 3:
            time_ms = _number(content)
        elif number == 4:
            kind = _kind(content)
        elif _METRIC_VALUE <= number <= _METRIC_VALUE + _TEMPLATE:
            raw = number - _METRIC_VALUE, content
    # At the end: the type may stand behind the value.
    if raw is not None:
        value = _decode_value(raw[0], raw[1], kind, room, depth)
    return Metric(name, kind, value, alias, time_ms)


def _decode_value(
    shape: int, content: int | bytes, kind: MetricType | None, room: list[int], depth: int
) -> Any:
    if shape == _DATA_SET:
        return _decode_data_set(_octets(content), room, depth)
    if shape == _TEMPLATE:
        return _decode_template(_octets(content), room, depth)
    value = _DECODERS[shape](content)
    # The wire has two's complement: only the type says whether it is negative.
    return signed(value, kind) if shape in {_INT, _LONG} else value


def signed(number: int, kind: MetricType | None) -> int:
    """Return the number of a signed type whose two's complement is *number*."""
    bits = _SIGNED_BITS.get(kind) if kind is not None else None
    if bits is None:
        return number
    number &= (1 << bits) - 1
    return number - (1 << bits) if number >> bits - 1 else number


def _decode_data_set(data: bytes, room: list[int], depth: int) -> DataSet:
    columns, types, rows = [], [], []
    for number, content in iter_fields(data):
        if number == 2:
            columns.append(_text(content))
        elif number == 3 and isinstance(content, int):
            types.append(_kind(content))
        elif number == 3:  # packed, as version 3 of protobuf's language has it by default
            types += map(_kind, _octets(content))
        elif number == 4:
            rows.append(_octets(content))
    found = []
    for row in rows:
        values = [_octets(content) for number, content in iter_fields(row) if number == 1]
        room[0] -= len(values)
        if len(values) != len(types) or room[0] < 0:
            raise MalformedError("a data set whose rows do not fit its columns", layout=_LAYOUT)
        found.append([
            _decode_element(each, kind, room, depth)
            for each, kind in zip(values, types, strict=True)
        ])  # fmt: skip
    return DataSet(columns, types, found)


def _decode_element(data: bytes, kind: MetricType, room: list[int], depth: int) -> Any:
    value = None
    for number, content in iter_fields(data):
        if _SET_VALUE <= number <= _SET_VALUE + _STRING:
            value = _decode_value(number - _SET_VALUE, content, kind, room, depth)
    return value


def _decode_template(data: bytes, room: list[int], depth: int) -> Template:
    metrics, reference, is_definition = [], "", False
    for number, content in iter_fields(data):
        if number == 2:
            metrics.append(_decode_metric(_octets(content), room, depth - 1))
        elif number == 4:
            reference = _text(content)
        elif number == 5:
            is_definition = bool(_number(content))
    return Template(metrics, reference, is_definition)


def _number(content: int | bytes) -> int:
    if not isinstance(content, int):
        raise MalformedError("bytes where a number is expected", layout=_LAYOUT)
    return content


def _octets(content: int | bytes) -> bytes:
    if isinstance(content, int):
        raise MalformedError("a number where bytes are expected", layout=_LAYOUT)
    return content


def _text(content: int | bytes) -> str:
    try:
        return _octets(content).decode()
    except UnicodeDecodeError:
        raise MalformedError("a text that is not UTF-8", layout=_LAYOUT) from None


def _decode_real(layout: struct.Struct, content: int | bytes) -> Any:
    octets = _octets(content)
    if len(octets) != layout.size:
        raise MalformedError(f"a number of {len(octets)} bytes", layout=_LAYOUT)
    return layout.unpack(octets)[0]


def _kind(content: int | bytes) -> MetricType:
    try:
        return MetricType(_number(content))
    except ValueError:
        raise MalformedError(f"unknown data type {content!r}", layout=_LAYOUT) from None


_DECODERS: tuple[Callable[[int | bytes], Any], ...] = (
    _number,
    _number,
    lambda content: _decode_real(_FLOAT_LAYOUT, content),
    lambda content: _decode_real(_DOUBLE_LAYOUT, content),
    lambda content: bool(_number(content)),
    _text,
    _octets,
)
