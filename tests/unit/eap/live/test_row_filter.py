"""Expressions that choose rows."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.live.row_filter import RowFilter
from eap.live.rows import PdFlow, StationRow

ROW: dict[str, Any] = {
    "plant": "line",
    "name": "Island-03",
    "state": "OP",
    "tx_per_s": 100.0,
    "rx_per_s": None,
    "lost": 3,
    "late": 0,
    "age_us": 4200,
    "jitter_p99_us": None,
    "bus": "2/2 OP",
}


def fits(text: str, **more: Any) -> bool:
    return RowFilter.parse(text, StationRow).fits(StationRow(**(ROW | more)))


@pytest.mark.parametrize(
    "text",
    ["", "lost>0", "lost>=3", "lost=3", "lost==3", "lost!=4", "late<1", "tx>99.5", "age>4ms",
     "age_us<=4200", "age<1s", "name=island-03", "name=ISLAND*", "name=*03", "state=OP",
     "state!=PREOP",
     "island", "LINE", "2/2", "island lost>0", "bus=2/2*"],
)  # fmt: skip
def test_row_fits(text: str) -> None:
    assert fits(text)


@pytest.mark.parametrize(
    "text",
    ["lost>3", "lost<3", "late!=0", "tx<100", "age>5ms", "name=island", "state!=OP", "press",
     "island lost=0", "rx>0", "rx=0", "rx<5", "rx!=1", "jitter>0"],
)  # fmt: skip
def test_row_does_not_fit(text: str) -> None:
    assert not fits(text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("lst>0", "no key 'lst', did you mean lost"),
        ("quite_other=0", "no key 'quite_other'; known keys: plant, name, state"),
        ("state>OP", "state is a text: compare it by = or !="),
        ("lost>many", "lost>many: expected a number"),
        ("lost>", "lost>: expected a number"),
        ("lost>1ms", "lost>1ms: expected a number"),
        ("lost>1.2.3", "lost>1.2.3: expected a number"),
        ("age>5h", "age>5h: expected a number, with us, ms or s"),
    ],
)
def test_expression_that_fits_no_row_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason.replace("?", r"\?")):
        RowFilter.parse(text, StationRow)


def test_keys_of_all_kinds_of_rows_are_known() -> None:
    assert not RowFilter.parse("dropped>0", StationRow, PdFlow).fits(StationRow(**ROW))


@given(st.text(max_size=40))
def test_any_text_is_parsed_or_refused(text: str) -> None:
    try:
        found = RowFilter.parse(text, StationRow, PdFlow)
    except ValueError:
        return
    found.fits(StationRow(**ROW))
