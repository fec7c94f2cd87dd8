"""A mailbox gateway as tables for people."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, TypeAlias

from rich.console import RenderableType
from rich.text import Text

from eap.cli.table import Column, TextTable
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
    dropped = f", {frames} dropped" if row["turned_away"] else ""
    yield Text(
        f"{row['station']}/{row['port']}: {row['state']} at {served};"
        f" answers within {settings['answer_ms']} ms{silent}{dropped}"
    )
    if row["clients"]:
        yield Text()
        latest = row["clients"][::-1]
        shown = [each for at, each in enumerate(latest) if at < _SHOWN_CLIENTS or each["transfers"]]
        yield _table(
            (
                "Client",
                Column("Door", rank=2),
                Column("Requests", is_number=True),
                Column("Repeated", rank=1, is_number=True),
                Column("Errors", is_number=True),
                Column("Transfers", wraps=True),
            ),
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
        yield Text()
        yield _table(
            (
                "Slave",
                "Protocol",
                Column("Requests", is_number=True),
                Column("Replies", rank=1, is_number=True),
                Column("Errors", is_number=True),
                Column("Mean", is_number=True),
                Column("Slowest", rank=2, is_number=True),
                Column("Last error", wraps=True),
            ),
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


def _table(columns: Iterable[Column | str], rows: Iterable[tuple[object, ...]]) -> TextTable:
    table = TextTable(*columns)
    for row in rows:
        table.add_row(*(Text(str(each)) for each in row))
    return table


def _time(value: float | None) -> str:
    return "" if not value else f"{value / 1000:.1f} ms"
