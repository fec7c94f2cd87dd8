from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.pd.words import (
    BIN_OF_US,
    HISTOGRAM_BINS,
    PD_DROP_REASONS,
    REASONS,
    FrameWord,
    RxWord,
    StationWord,
    TxWord,
    bin_upper_edge,
    histogram_bin,
    percentile,
)

ARRAYS = {
    "DISCARDED": len(PD_DROP_REASONS),
    "LATENESS": HISTOGRAM_BINS,
    "REASON": len(REASONS),
    "JITTER": HISTOGRAM_BINS,
}


@pytest.mark.parametrize("block", [StationWord, FrameWord, TxWord, RxWord])
def test_no_word_means_two_things(block):
    used = []
    for name, word in block.__members__.items():
        if name != "SIZE":
            used += range(word, word + ARRAYS.get(name, 1))
    assert sorted(used) == list(range(block.SIZE))


@given(st.integers(0, 1 << 40))
def test_histogram_bins_match_their_edges(value):
    index = histogram_bin(value)
    assert 0 <= index < HISTOGRAM_BINS
    if index:
        assert value > bin_upper_edge(index - 1)
    if index < HISTOGRAM_BINS - 1:
        assert value <= bin_upper_edge(index)


def test_bins_are_at_most_a_quarter_wide_and_looked_up_alike():
    for index in range(8, HISTOGRAM_BINS):
        assert (bin_upper_edge(index) + 1) / (bin_upper_edge(index - 1) + 1) <= 1.25
    assert list(BIN_OF_US) == [histogram_bin(value) for value in range(4096)]
    assert histogram_bin(-5) == 0


def test_percentile_of_nothing_is_none():
    assert percentile([0] * HISTOGRAM_BINS, 0.5) is None


@given(st.lists(st.integers(0, 100_000), min_size=1, max_size=50), st.sampled_from([0.5, 0.99, 1]))
def test_percentile_is_the_edge_of_the_bin_of_the_sorted_value(values, share):
    bins = [0] * HISTOGRAM_BINS
    for value in values:
        bins[histogram_bin(value)] += 1
    rank = -(-len(values) * share // 1)
    exact = sorted(values)[int(rank) - 1]
    assert percentile(bins, share) == bin_upper_edge(histogram_bin(exact))
