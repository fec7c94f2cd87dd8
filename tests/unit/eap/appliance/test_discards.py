"""Counters of services: they survive it."""

from __future__ import annotations

import pytest

from eap.appliance.discards import DiscardCounters, Refusal


def test_counts_by_station_and_reason_survive_a_restart(tmp_path):
    path = tmp_path / "discards"
    with DiscardCounters(path, ["a", "b"]) as counters:
        counters.count("a", Refusal.MAILBOX)
        counters.count("a", Refusal.MAILBOX, 2)
        counters.count("b", Refusal.ENGINE_BUSY)
    with DiscardCounters(path, ["a", "b"]) as counters:
        assert counters.stats() == {"a": {"mailbox": 3}, "b": {"engine_busy": 1}}
        counters.count("b", Refusal.STALE, 5)
        assert counters.stats()["b"] == {"stale": 5, "engine_busy": 1}


def test_an_unknown_station_is_a_mistake_of_ours(tmp_path):
    with DiscardCounters(tmp_path / "discards", []) as counters:
        assert counters.stats() == {}
        with pytest.raises(KeyError):
            counters.count("a", Refusal.MAILBOX)
