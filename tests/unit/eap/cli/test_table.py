from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from eap.cli.output import Column, TextTable


def lines(table: TextTable, width: int) -> list[str]:
    console = Console(width=width, highlight=False)
    with console.capture() as capture:
        console.print(table)
    return [line.rstrip() for line in capture.get().splitlines()]


def sample() -> TextTable:
    table = TextTable(
        "Station",
        Column("Says", wraps=True),
        Column("Serial", rank=1),
        Column("Alias", rank=2),
        Column("Lost", is_number=True),
    )
    table.add_row("island-01/bus0", "the slave does not answer", "SER-1", "A-1", "12")
    table.add_row("island-02", "", "SER-2", "A-2", "3")
    table.add_row("short")
    return table


def test_table_is_as_wide_as_it_needs() -> None:
    assert lines(sample(), 100) == [
        "Station         Says                       Serial  Alias  Lost",
        "─" * 62,
        "island-01/bus0  the slave does not answer  SER-1   A-1      12",
        "island-02                                  SER-2   A-2       3",
        "short",
    ]


def test_table_wraps_at_spaces_before_it_leaves_out_a_column() -> None:
    assert lines(sample(), 60)[2:4] == [
        "island-01/bus0  the slave does not       SER-1   A-1      12",
        "                answer",
    ]


def test_table_omits_the_highest_rank_first_and_names_it() -> None:
    assert lines(sample(), 52)[0].split() == ["Station", "Says", "Serial", "Lost"]
    assert lines(sample(), 52)[-1] == "not shown for lack of width: Alias"
    assert lines(sample(), 45)[-1] == "not shown for lack of width: Serial, Alias"


@pytest.mark.parametrize("width", [1, 5, 20, 42])
def test_table_breaks_words_when_nothing_can_be_left_out(width: int) -> None:
    assert max(map(len, lines(sample(), width))) == width


@given(
    st.lists(st.lists(st.text("ab \n-é漢", max_size=30), max_size=5), max_size=4),
    st.integers(1, 60),
)
def test_table_never_exceeds_its_width(rows: list[list[str]], width: int) -> None:
    table = TextTable(
        "A", Column("Long heading", 1), Column("W", 0, wraps=True), "X", Column("", 2)
    )
    for row in rows:
        table.add_row(*row)
    assert max((len(line) for line in lines(table, width)), default=0) <= width
