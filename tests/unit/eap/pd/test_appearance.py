"""Guesses of the content of unknown process data."""

from __future__ import annotations

import math
import random
import struct

from hypothesis import given
from hypothesis import strategies as st

from eap.pd.appearance import MAX_PARTS, LikelyVariable, guess


def test_numbers_texts_and_flags_are_recognised():
    noise = random.Random(1)
    samples = [
        struct.pack(
            "<HfIdB16s20s",
            0,
            180.5 + n / 7,
            70_000 + n,
            -0.001 * (n + 1),
            n % 2,
            b"mixer 3",
            noise.randbytes(20),
        )
        for n in range(8)
    ]
    found = guess(samples)
    assert [(part.offset, part.type) for part in found] == [
        (0, "BLOCK(2)"),
        (2, "REAL"),
        (6, "UDINT"),
        (10, "LREAL"),
        (18, "BYTE"),
        (19, "STRING(16)"),
        (35, "BLOCK(20)"),
    ]
    assert "180.5" in found[1].text
    assert found[2].text == "a counter, 1 more each time"
    assert (found[0].text, found[-1].text) == ("all zero", "changing")
    assert str(found[4]) == "byte 18: BYTE, 0 or 1: a flag"


def test_counter_of_two_bytes_wraps():
    samples = [struct.pack("<HH", 65_533 + n & 0xFFFF, 0xABCD) for n in range(6)]
    assert guess(samples)[0][:3] == (0, 2, "UINT")


def test_set_point_with_few_digits_is_a_constant_number():
    assert guess([struct.pack("<f", 750.0)] * 3) == [LikelyVariable(0, 4, "REAL", "750, constant")]


def test_slow_sine_is_a_number_and_no_counter_of_its_low_bytes():
    for phase in range(0, 628, 7):
        values = [180 + 12.5 * math.sin(phase / 100 + n * 0.00628) for n in range(8)]
        assert guess([struct.pack("<f", value) for value in values])[0].type == "REAL"


def test_counter_with_uneven_steps():
    samples = [struct.pack("<I", value) for value in (100, 101, 103, 104, 105, 108)]
    assert guess(samples) == [LikelyVariable(0, 4, "UDINT", "a counter")]


def test_small_numbers_with_a_sign():
    samples = [struct.pack("<i", value) for value in (-3, 4, -100, 7, 5, 4)]
    assert guess(samples)[0][:3] == (0, 4, "DINT")


def test_too_few_samples_or_no_data_give_no_guess():
    assert guess([b"ab", b"cd"]) == guess([]) == guess([b""] * 5) == []


@given(st.integers(1, 64).flatmap(
    lambda size: st.lists(st.binary(min_size=size, max_size=size), min_size=3, max_size=8)
))  # fmt: skip
def test_guess_covers_all_bytes_once(samples):
    parts = guess(samples)
    end = 0
    for part in parts:
        assert part.offset == end
        end += part.size
    assert end == len(samples[0])
    assert len(parts) <= MAX_PARTS
