"""A mailbox gateway as tables for people."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeAlias

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from eap.cli.bus_view import make_table
from eap.cli.words import count

Row: TypeAlias = dict[str, Any]

_SHOWN_CLIENTS = 10
"""Each command is a client of its own, so there are soon hundreds."""


def gateway_tables(row: Row) -> Iterator[RenderableType]:
    """Yield how one gateway is, its clients, and what was asked of the master and the slaves."""
    settings = row["settings"]
    served = ", ".join(row["served"]) or "nowhere"
    silent = ", silent" if settings["silent"] else ""
    frames = count(row["turned_away"], "frame")
    turned_away = f", {frames} turned away" if row["turned_away"] else ""
    yield Text(
        f"{row['station']}/{row['port']}: {row['state']} at {served};"
        f" answers within {settings['answer_ms']} ms{silent}{turned_away}"
    )
    if row["clients"]:
        latest = row["clients"][::-1]
        shown = [each for at, each in enumerate(latest) if at < _SHOWN_CLIENTS or each["transfers"]]
        yield _table(
            ("Client", "Door", "Requests", "Repeated", "Errors", "Transfers"),
            (
                (
                    each["address"],
                    each["door"],
                    each["requests"],
                    each["repeated"],
                    each["errors"],
                    ", ".join(f"{one['protocol']} {one['address']}" for one in each["transfers"]),
                )
                for each in shown
            ),
        )
        if left := len(latest) - len(shown):
            yield Text(f"  {count(left, 'client')} more asked before these; --json shows all")
    if row["slaves"]:
        yield _table(
            ("Slave", "Protocol", "Requests", "Replies", "Errors", "Mean", "Slowest", "Last error"),
            (
                (
                    each["address"] or "master",
                    each["protocol"],
                    each["requests"],
                    each["replies"],
                    sum(each["errors"].values()),
                    _time(each["mean_us"]),
                    _time(each["slowest_us"]),
                    each["last_error"],
                )
                for each in row["slaves"]
            ),
        )


def _table(titles: tuple[str, ...], rows: Iterator[tuple[object, ...]]) -> Table:
    table = make_table(*titles)
    for row in rows:
        table.add_row(*(Text(str(each)) for each in row))
    return table


def _time(value: float | None) -> str:
    return "" if not value else f"{value / 1000:.1f} ms"
