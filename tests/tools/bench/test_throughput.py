"""Figures of throughput and latency, and contenders that are missing."""

from __future__ import annotations

from typing import Any

import pytest

from tools.bench import latency, rawloop, throughput
from tools.bench.endpoints import Endpoint
from tools.bench.figures import Decision
from tools.bench.throughput import OURS, RAW, C, Case

SHAPE = throughput.CASES[0].shape
CASE = Case("frames", SHAPE, {RAW: 1.0, C: None}, C)


def test_rates_are_compared_by_round_and_name_their_limit() -> None:
    rates = {OURS.name: [90e3, 50e3], RAW.name: [100e3, 50e3], C.name: [200e3, 200e3]}
    raw, c = throughput.figures_of(CASE, rates)
    assert (raw.value, raw.decision) == (0.95, Decision.MISSED)
    assert raw.measured == "0.95 (70 of 75 thousand/s)"
    assert raw.limit == "the C loop: 200 thousand/s"
    assert (c.value, c.decision, c.limit) == (0.35, Decision.REPORTED, "")


def test_missing_compiler_leaves_out_the_c_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    assert C.lacks() == rawloop.NEEDS
    raw, c = throughput.figures_of(CASE, {OURS.name: [1.0], RAW.name: [1.0]})
    assert (c.decision, c.measured) == (Decision.SKIPPED, rawloop.NEEDS)
    assert raw.limit == "the C loop, not measured"


def test_missing_package_is_named() -> None:
    peer = Endpoint("a peer", "peer.send", "peer.receive", ("py-peer", "no_such_module"))
    assert peer.lacks() == "needs py-peer"
    assert not RAW.lacks()


def test_latencies_are_compared_with_each_contender() -> None:
    def spread(p50: int) -> list[dict[str, Any]]:
        return [{"p50": p50, "p99": 2 * p50, "max": 10 * p50}] * 2

    results = {latency.OURS.name: spread(12_000), latency.RAW.name: spread(10_000)}
    raw, *others, tails = latency.figures_of("on", 1.15, results | {latency.C.name: spread(8_000)})
    assert (raw.value, raw.decision, raw.limit) == (1.2, Decision.MISSED, "the C loop: 8.0 µs")
    assert others[0].measured == "1.50 (12.0 to 8.0 µs)"
    assert tails.measured == "p99 24.0 to 20.0 µs, max 120.0 to 100.0 µs"
