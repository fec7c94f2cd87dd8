"""Payloads of Sparkplug B: bytes written by hand, round trips, broken ones."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.sparkplug import (
    MAX_METRICS,
    DataSet,
    Metric,
    MetricType,
    SparkplugPayload,
    Template,
    decode_payload,
    encode_payload,
    signed,
)
from eap.errors import CodecError


def message(number: int, *parts: str) -> bytes:
    """Return a field of length-delimited bytes, all shorter than 128."""
    content = bytes.fromhex("".join(parts))
    return bytes([number << 3 | 2, len(content)]) + content


# By hand from sparkplug_b.proto: of a payload timestamp 1, metrics 2, seq 3; of a metric name 1,
# alias 2, timestamp 3, datatype 4, is_null 7, properties 9, int_value 10, float_value 12.
QUALITY = message(9, "0a 07 51 75 61 6c 69 74 79", "12 05 08 03 18 c0 01")
HAND_MADE = (
    bytes.fromhex("08 e8 07")
    + message(2, "0a 05 73 70 65 65 64", "10 07", "18 e7 07", "20 09", QUALITY.hex(),
              "65 00 00 c0 3f")
    + message(2, "10 08", "20 02", "50 fe ff ff ff 0f")
    + message(2, "10 09", "20 0b", "38 01")
    + bytes.fromhex("18 05")
)  # fmt: skip
METRICS = [
    Metric("speed", MetricType.FLOAT, 1.5, 7, 999, [("Quality", 192)]),
    Metric("", MetricType.INT16, -2, 8),
    Metric("", MetricType.BOOLEAN, None, 9),
]


def test_payload_is_encoded_as_by_hand():
    assert encode_payload(1000, METRICS, 5).hex(" ") == HAND_MADE.hex(" ")


def test_payload_by_hand_is_decoded():
    bare = [METRICS[0]._replace(properties=()), *METRICS[1:]]
    assert decode_payload(HAND_MADE) == SparkplugPayload(1000, 5, bare)


def test_signed_number_is_that_of_its_type():
    assert signed(0xFFFF_FFFE, MetricType.INT16) == -2
    assert signed(0xFFFE, MetricType.INT16) == -2
    assert signed(0xFFFE, MetricType.UINT16) == 0xFFFE
    assert signed(0xFFFE, None) == 0xFFFE


VALUES = [
    (MetricType.INT8, -128), (MetricType.INT32, -1), (MetricType.INT64, -(1 << 63)),
    (MetricType.UINT64, (1 << 64) - 1), (MetricType.DOUBLE, 1e300), (MetricType.BOOLEAN, False),
    (MetricType.STRING, "Grad °"), (MetricType.BYTES, bytes(range(200))),
    (MetricType.DATA_SET, DataSet(["x", "y"], [MetricType.INT8, MetricType.STRING],
                                  [[-1, "a"], [2, None]])),
    (MetricType.TEMPLATE, Template(
        [Metric("pos", MetricType.FLOAT, 2.0),
         Metric("inner", MetricType.TEMPLATE, Template([], "Inner"))], "Axis", is_definition=False,
    )),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "value"), VALUES, ids=lambda each: str(each)[:12])
def test_metric_round_trip(kind, value):
    payload = encode_payload(1, [Metric("x", kind, value)], 0)
    assert decode_payload(payload).metrics == [Metric("x", kind, value)]


def test_float_too_large_for_its_type_is_infinite():
    payload = encode_payload(1, [Metric("x", MetricType.FLOAT, -1e300)], 0)
    assert decode_payload(payload).metrics[0].value == float("-inf")


def test_payload_with_too_many_metrics_is_refused():
    payload = encode_payload(1, [Metric("", None, None)] * (MAX_METRICS + 1), 0)
    with pytest.raises(CodecError, match="more than"):
        decode_payload(payload)


def test_payload_nested_too_deep_is_refused():
    value = Template([])
    for _ in range(20):
        value = Template([Metric("x", MetricType.TEMPLATE, value)])
    payload = encode_payload(1, [Metric("x", MetricType.TEMPLATE, value)], 0)
    with pytest.raises(CodecError, match="nested too deep"):
        decode_payload(payload)


@pytest.mark.parametrize("size", range(1, len(HAND_MADE)))
def test_truncated_payload_raises_nothing_but_codec_errors(size):
    with suppress(CodecError):
        assert decode_payload(HAND_MADE[:size]) is not None


@given(st.binary(max_size=200))
def test_any_bytes_raise_nothing_but_codec_errors(data):
    with suppress(CodecError):
        assert decode_payload(data) is not None
