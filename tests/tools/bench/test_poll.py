"""Figures of the cycles from poll request to answer."""

from __future__ import annotations

import pytest

from tools.bench.figures import Decision
from tools.bench.poll import figures_of

COLD = [9] * 20
RESPONSE = {"last": 530, "p50": 535, "p99": 639, "max": 1200}


def found(*trips: int) -> dict[str, object]:
    return {"trips": [*COLD, *trips], "asked": 50, "response_us": RESPONSE}


def test_the_first_answers_are_left_out() -> None:
    trip, response = figures_of(500, found(1, 1, 1, 2))
    assert (trip.value, trip.decision) == (1, Decision.OK)
    assert trip.measured == "1 cycles (p99 2, max 2, of 4 answers)"
    assert response.measured == "p50 535 µs, p99 639 µs, max 1200 µs"


@pytest.mark.parametrize(
    ("phase_us", "trips", "decision"),
    [
        (500, (2, 2, 2), Decision.MISSED),
        (0, (2, 2, 2), Decision.OK),
        (750, (2, 2, 1), Decision.OK),
        (750, (3, 3, 3), Decision.MISSED),
    ],
)
def test_an_answer_waits_for_two_cycles_at_most(
    phase_us: int, trips: tuple[int, ...], decision: Decision
) -> None:
    assert figures_of(phase_us, found(*trips))[0].decision is decision


def test_a_server_that_never_answers_is_a_failure() -> None:
    with pytest.raises(RuntimeError, match="no answer to 50 requests"):
        figures_of(500, found())
