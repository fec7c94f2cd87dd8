"""Counters of services: they survive it."""

from __future__ import annotations

import pytest

from eap.errors import EnvironmentalError
from eap.runtime.drop_counters import DropCounterFeed, DropCounters, DropReason


def test_counts_by_station_and_reason_survive_a_restart(tmp_path):
    path = tmp_path / "discards"
    with DropCounters(path, ["a", "b"]) as counters:
        counters.count("a", DropReason.MAILBOX)
        counters.count("a", DropReason.MAILBOX, 2)
        counters.count("b", DropReason.ENGINE_BUSY)
    with DropCounters(path, ["a", "b"]) as counters:
        assert counters.stats() == {"a": {"mailbox": 3}, "b": {"engine_busy": 1}}
        counters.count("b", DropReason.STALE, 5)
        assert counters.stats()["b"] == {"stale": 5, "engine_busy": 1}


def test_a_file_that_cannot_be_made_is_named(tmp_path):
    with pytest.raises(EnvironmentalError, match="nowhere"):
        DropCounters(tmp_path / "nowhere" / "discards", ["a"])


def test_drop_counter_feed_adds_new_counts(tmp_path):
    source = {"other_vlan": 2}
    with DropCounters(tmp_path / "discards", ["a", "b"]) as counters:
        tally = DropCounterFeed(
            counters, ["a"], source, lambda n: None if n == "own" else DropReason(n)
        )
        tally.publish()
        source |= {"other_vlan": 5, "stale": 1, "own": 7}
        tally.publish()
        tally.publish()
        assert counters.stats() == {"a": {"other_vlan": 5, "stale": 1}, "b": {}}


def test_an_unknown_station_is_a_mistake_of_ours(tmp_path):
    with DropCounters(tmp_path / "discards", []) as counters:
        assert counters.stats() == {}
        with pytest.raises(KeyError):
            counters.count("a", DropReason.MAILBOX)
