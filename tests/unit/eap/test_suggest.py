from __future__ import annotations

from eap.suggest import nearest, suggest


def test_near_names_are_offered() -> None:
    for known in (["name", "cycle_us"], {"cycle_us": 1, "name": 2}):
        assert nearest("cylce_us", known) == "cycle_us"
        assert suggest("cylce_us", known) == ", did you mean cycle_us?"


def test_names_that_are_not_near_are_not() -> None:
    for known in (["entirely different"], []):
        assert nearest("cycle_us", known) is None
        assert suggest("cycle_us", known) == ""
