from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.config.links import Ends, Span, ends, find_circles, in_order, is_bitwise, is_scaled
from eap.config.structs import Link

UINT, BOOL = datatypes.parse("UINT"), datatypes.parse("BOOL")


def way(source, target, start=0, to=0, bits=16):
    return Ends(Span(source, start, bits), Span(target, to, bits))


@pytest.mark.parametrize(
    ("keys", "source", "target", "bits"),
    [
        ({}, UINT, UINT, (0, 0, 16)),
        ({"from_bit": 3}, UINT, BOOL, (3, 0, 1)),
        ({"to_bit": 15}, BOOL, UINT, (0, 15, 1)),
        ({"from_bit": 8}, UINT, UINT, (8, 0, 8)),
        ({"from_bit": 8, "to_bit": 12, "bits": 2}, UINT, UINT, (8, 12, 2)),
    ],
)
def test_bits_are_as_many_as_both_ends_have(keys, source, target, bits):
    link = Link(source="a", target="b", **keys)
    found = ends(link, source, target)
    assert (found.source.start, found.target.start, found.source.bits) == bits
    assert found.target.bits == found.source.bits
    assert is_bitwise(link) == bool(keys)


def test_a_link_computes_when_it_has_a_scale_or_an_offset():
    assert is_scaled(Link(source="a", target="b", offset=0.0))
    assert is_scaled(Link(source="a", target="b", scale=2.0))
    assert not is_scaled(Link(source="a", target="b", swap=True))


def test_a_link_runs_behind_those_that_write_what_it_reads():
    chain = [way("c", "d"), way("b", "c"), way("x", "y"), way("a", "b")]
    assert in_order(chain) == [2, 3, 1, 0]
    assert find_circles(chain) == []


def test_other_bits_of_a_variable_are_no_reason_to_wait():
    links = [
        way("w", "x", start=4, bits=2),
        way("a", "w", to=0, bits=4),
        way("b", "w", to=6, bits=1),
    ]
    assert in_order(links) == [0, 1, 2]
    assert in_order([way("w", "x", start=3, bits=2), *links[1:]]) == [1, 0, 2]


def test_a_shift_register_is_no_circle():
    links = [way("w", "w", 1, 2, 1), way("w", "w", 0, 1, 1)]
    assert in_order(links) == [1, 0]


def test_circles_are_named_in_the_way_of_the_values():
    links = [way("behind", "end"), way("a", "b"), way("c", "a"), way("b", "c"), way("c", "behind")]
    assert in_order(links) == []
    assert find_circles(links) == [[1, 3, 2]]
    assert find_circles([way("a", "a"), way("b", "c"), way("c", "b")]) == [[0], [1, 2]]


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12))
def test_links_are_in_order_or_in_a_circle(pairs):
    links = [way(str(source), str(target)) for source, target in pairs]
    order, circles = in_order(links), find_circles(links)
    assert bool(circles) == (len(order) < len(links))
    for place, position in enumerate(order):
        writers = [n for n, (_, target) in enumerate(pairs) if target == pairs[position][0]]
        assert set(writers) <= set(order[:place])
    for circle in circles:
        for position, following in zip(circle, [*circle[1:], circle[0]], strict=True):
            assert pairs[position][1] == pairs[following][0]
