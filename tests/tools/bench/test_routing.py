"""The benchmark of routing: it passes packets, and looks up what it says."""

from __future__ import annotations

import pytest

from tools.bench import routing
from tools.bench.settings import Settings


def test_look_ups_find_and_packets_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(routing, "_CALLS", 20)
    monkeypatch.setattr(routing, "_MANY", 50)
    figures = routing.run(Settings(micro_repeats=1))
    assert [figure.name for figure in figures] == [
        "look-up exact: 50 routes, ratio to 10",
        "look-up by four bytes: 50 routes, ratio to 10",
        "a packet through a router",
        "a packet through a router with 50 routes",
    ]
    assert all(figure.value for figure in figures)
