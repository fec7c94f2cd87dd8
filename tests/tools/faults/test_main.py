"""Each fault of docs/faults.md against a running bus."""

from __future__ import annotations

import pytest

from devicebus.sim.spec import FaultKind
from tools.faults.__main__ import PAGE, put_into
from tools.faults.case import CASES
from tools.faults.trial import Row, Trial


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return [Trial(case).run() for case in CASES]


def test_every_kind_of_fault_is_tried() -> None:
    assert {fault.kind for case in CASES for fault in case.faults} == set(FaultKind)


def test_page_says_what_happens(rows: list[Row]) -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert put_into(text, rows) == text, "make it anew: python -m tools.faults --write"


def test_every_fault_is_reported(rows: list[Row]) -> None:
    silent = [row.what for row in rows if not (row.events or row.counters or row.request)]
    assert silent == ["the clock of `drive` runs 200 ppm fast"]
