"""Figures, their results and their tables."""

from __future__ import annotations

import pytest

from tools.bench.figures import (
    Decision,
    Figure,
    at_least,
    at_most,
    markdown_table,
    median_ratio,
    percentile,
    replace_between,
    skipped,
    text_table,
)


@pytest.mark.parametrize(
    ("figure", "decision"),
    [
        (at_least("a", 0.7, 0.7), Decision.OK),
        (at_least("a", 0.69, 0.7), Decision.MISSED),
        (at_most("a", 1.3, 1.3), Decision.OK),
        (at_most("a", 1.31, 1.3), Decision.MISSED),
        (skipped("a", "needs root"), Decision.SKIPPED),
    ],
)
def test_decision_follows_the_target(figure: Figure, decision: Decision) -> None:
    assert figure.decision is decision


@pytest.mark.parametrize(
    ("share", "expected"), [(0.5, 50), (0.99, 99), (0.999, 100), (1.0, 100), (0.0, 1)]
)
def test_percentile_is_the_smallest_value_with_that_share_below(
    share: float, expected: int
) -> None:
    assert percentile(list(range(100, 0, -1)), share) == expected


def test_median_ratio_compares_within_each_round() -> None:
    # The machine was twice as slow in the last round: the ratio does not see it.
    assert median_ratio([(80, 100), (90, 100), (40, 50)]) == 0.8


def test_text_table_aligns_columns() -> None:
    table = text_table([at_least("long name", 1.0, 0.5, "1 of 1"), skipped("b", "needs root")])
    assert table.splitlines() == [
        "figure     target  measured       result",
        "---------  ------  -------------  -------",
        "long name  ≥ 0.5   1.00 (1 of 1)  ok",
        "b                  needs root     skipped",
    ]


def test_markdown_table_has_a_row_for_each_figure() -> None:
    rows = markdown_table([at_most("memory", 33.4, 60, " MB")]).splitlines()
    assert rows[2:] == ["| memory | ≤ 60 MB | 33.4 MB | ok |"]


def test_tables_show_limits_where_they_are_wanted() -> None:
    figure = at_least(
        "stations", 85, 300, "76 %", unit=" stations", limit="at 113 some cycles lost"
    )
    assert figure.measured == "85 stations (76 %)"
    assert markdown_table([figure], limits=True).splitlines() == [
        "| figure | target | measured | result | limit |",
        "|---|---|---|---|---|",
        "| stations | ≥ 300 stations | 85 stations (76 %) | missed | at 113 some cycles lost |",
    ]
    assert "limit" not in text_table([figure])
    assert text_table([figure], limits=True).splitlines()[2].endswith("at 113 some cycles lost")


def test_replace_between_keeps_everything_outside() -> None:
    assert replace_between("a <b> old <e> z", "<b>", "<e>", "new") == "a <b>\nnew\n<e> z"


def test_replace_between_wants_both_markers() -> None:
    with pytest.raises(ValueError, match="<e>"):
        replace_between("a <b> old", "<b>", "<e>", "new")
