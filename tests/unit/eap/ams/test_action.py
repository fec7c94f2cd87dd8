from __future__ import annotations

from eap.ams.record import Outcome


def test_outcomes_have_the_names_that_people_read() -> None:
    assert sorted(Outcome) == [
        "answered", "denied", "dropped", "failed", "interrupted", "late", "loop", "restored",
    ]  # fmt: skip
