"""Values recorded in a CSV file, one row after the other and then from the start again."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from eap.errors import EnvironmentalError


class CsvReplay:
    """One column of a file; values are texts, the variable's data type reads them."""

    def __init__(self, values: Sequence[str], period_ns: int) -> None:
        self._values = values
        self._period_ns = period_ns

    def value(self, elapsed_ns: int) -> str:
        """Return the value of the row whose turn it is *elapsed_ns* after the start."""
        return self._values[elapsed_ns // self._period_ns % len(self._values)]


def open_replay(path: Path, column: str, *, period_ms: int) -> CsvReplay:
    """Read *column* of the file, whose first row names the columns.

    Raises:
        EnvironmentalError: the file cannot be read, or has no such column or no rows.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file, strict=True)
            if column not in (rows.fieldnames or ()):
                raise EnvironmentalError(f"{path}: there is no column {column!r}")
            values = [row[column] or "" for row in rows]
    except OSError as exc:
        raise EnvironmentalError(f"{path}: {exc.strerror}") from None
    except (csv.Error, UnicodeDecodeError) as exc:
        raise EnvironmentalError(f"{path} is no CSV file in UTF-8: {exc}") from None
    if not values:
        raise EnvironmentalError(f"{path}: there are no rows below the names of the columns")
    return CsvReplay(values, period_ms * 1_000_000)
