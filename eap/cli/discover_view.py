"""Text views of discovered process data: a table of PDs, or of publishers, and what is odd."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from eap.cli.output import Column, Styled, TextTable
from eap.live.findings import PUBLISHER_HINT, VERSION_HINT
from eap.quantities import count, duration

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType, RenderResult

    from eap.ops.discover import DiscoveredPd, ObserverFeed

_SPARE_LINES = 4
"""Lines of a live screen beside the rows: heading, column names, rule, prompt."""
_TRIGGERS = {
    "change": "on change",
    "change_timeout": "on change",
    "event": "event",
    "poll": "polled",
}
_LISTED = 3
_HINTS = {"wrong_publisher": PUBLISHER_HINT, "version": VERSION_HINT}


def discovery_view(rows: Sequence[DiscoveredPd]) -> Iterator[TextTable | str]:
    """Yield the table of all PDs."""
    yield pd_table(rows)
    yield summary(rows)


def summary(rows: Sequence[DiscoveredPd]) -> str:
    """Return the numbers of PDs and publishers in a line."""
    publishers = len({row.publisher for row in rows})
    taken = sum(row.taken_by is not None for row in rows)
    return f"{count(len(rows), 'PD')} of {count(publishers, 'publisher')}, {taken} taken"


def pd_table(rows: Sequence[DiscoveredPd]) -> TextTable:
    """Return a line for each PD."""
    has_names = any(row.name for row in rows)
    table = TextTable(
        "Publisher",
        Column("ID", is_number=True),
        Column("Version", rank=6, is_number=True),
        Column("Bytes", rank=3, is_number=True),
        Column("Hz", rank=2, is_number=True),
        "Sent",
        Column("Jitter", rank=4, is_number=True),
        "To",
        *([Column("Name", rank=5)] if has_names else []),
        Column("Taken by", wraps=True),
    )
    for row in rows:
        table.add_row(
            row.publisher,
            str(row.pd_id),
            str(row.version),
            str(row.length),
            rate(row.rate_hz),
            trigger_text(row),
            duration(row.jitter_us),
            destination_text(row),
            *([row.name or ""] if has_names else []),
            row.taken_by or Styled("none", style="yellow"),
        )
    return table


def publisher_table(rows: Sequence[DiscoveredPd]) -> TextTable:
    """Return a line for each publisher, for a screen that has no room for all PDs."""
    table = TextTable(
        "Publisher",
        Column("PDs", is_number=True),
        Column("Taken", is_number=True),
        Column("Hz", is_number=True),
        Column("Jitter", is_number=True),
        Column("From", wraps=True),
    )
    for publisher in dict.fromkeys(row.publisher for row in rows):
        own = [row for row in rows if row.publisher == publisher]
        jitter = [row.jitter_us for row in own if row.jitter_us is not None]
        sources = dict.fromkeys(source for row in own for source in row.sources)
        table.add_row(
            publisher,
            str(len(own)),
            str(sum(row.taken_by is not None for row in own)),
            rate(sum(row.rate_hz or 0 for row in own)),
            duration(max(jitter)) if jitter else "",
            ", ".join(sources),
        )
    return table


class _LiveTable:
    """The PDs if the screen has a line for each, else the publishers."""

    def __init__(self, rows: Sequence[DiscoveredPd]) -> None:
        self._rows = rows

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        del options
        if len(self._rows) + _SPARE_LINES <= console.height or not console.is_terminal:
            yield pd_table(self._rows)
        else:
            yield publisher_table(self._rows)


def live_view(
    rows: Sequence[DiscoveredPd], discovery: ObserverFeed, interface: str
) -> Iterator[RenderableType]:
    """Yield the screen of a running capture."""
    losses = " ".join(discovery.losses.lines())
    heading = Styled(f"{interface}: {summary(rows)}", style="bold")
    yield heading.append("  Ctrl-C ends", "dim").append(f"  {losses}", "red")
    if rows:
        yield _LiveTable(rows)


def rate(hertz: float | None) -> str:
    """Return a rate in as few digits as say it; empty if it is not known."""
    if hertz is None:
        return ""
    return f"{hertz:.0f}" if hertz >= 100 else f"{hertz:.3g}"


def trigger_text(row: DiscoveredPd) -> str:
    """Return how a PD is sent: its period, or the guessed trigger."""
    if row.period_ms is not None and row.trigger == "cycle":
        return f"{row.period_ms:g} ms"
    text = _TRIGGERS.get(row.trigger or "", "?")
    return f"{text}, {row.timeout_ms} ms" if row.timeout_ms else text


def destination_text(row: DiscoveredPd) -> str:
    """Return the address that a PD goes to, its VLAN, and its port where that is not the usual."""
    vlan = "" if row.vlan_id is None else f" VLAN {row.vlan_id}"
    scheme = "tcp " if row.transport == "tcp" else ""
    return f"{scheme}{row.destination}{vlan}"


def notes(rows: Sequence[DiscoveredPd], discovery: ObserverFeed) -> Iterator[str]:
    """Yield what an operator should look at, the losses of the capture among it."""
    yield from discovery.losses.lines()
    for publisher in dict.fromkeys(row.publisher for row in rows):
        yield from _publisher_notes(publisher, [row for row in rows if row.publisher == publisher])
    reasons = set()
    for row in rows:
        for refused in row.refused_by[:_LISTED]:
            reasons.add(refused.reason)
            where = f"PD {row.pd_id} of {row.publisher}"
            yield f"{where}: {refused.entry} drops it: {reason_text(row, refused.reason)}"
    # Once for all of them: the likely reason is a habit of the sender.
    yield from (hint for reason, hint in _HINTS.items() if reason in reasons)
    others = discovery.observer.other_types
    if others and not rows:
        types = ", ".join(f"type {kind}: {number}" for kind, number in sorted(others.items()))
        yield f"no process data, but other EtherCAT frames: {types}"
    elif not rows:
        yield (
            "no process data seen: a switch passes on to a port only what is sent to it; watch at"
            " a mirror port, or longer"
        )


def _publisher_notes(publisher: str, rows: Sequence[DiscoveredPd]) -> Iterator[str]:
    lengths = {row.header_length for row in rows} - {None}
    if lengths:
        wrong = " or ".join(map(str, sorted(filter(None, lengths))))
        yield (
            f"{publisher}: wrong length in its EtherCAT header ({wrong}): "
            "a port takes its frames with length: lenient"
        )
    orders = {row.cycle_order for row in rows}
    if "swapped" in orders:
        yield f"{publisher}: its cycle counter is byte-swapped: losses cannot be counted"
    elif "constant" in orders:
        yield f"{publisher}: its cycle counter never changes: losses cannot be counted"
    sources = {source.partition(":")[0] if "." in source else source
               for row in rows for source in row.sources}  # fmt: skip
    if len(sources) > 1:
        yield (
            f"{publisher}: sent from {len(sources)} addresses: "
            f"{', '.join(sorted(sources))}; give each sender a NetID of its own"
        )
    if missed := sum(row.missed for row in rows):
        yield f"{publisher}: {missed} PDs missing by its cycle counter: lost on the way or here"
    if repeated := sum(row.repeated for row in rows):
        yield f"{publisher}: {repeated} PDs repeated: neither cycle counter nor toggle bit changed"


def reason_text(row: DiscoveredPd, reason: str) -> str:
    """Return in words why a subscription drops a PD."""
    if reason == "other_destination":
        return f"its port gets no frames to {row.destination}"
    if reason == "version":
        return f"another version than {row.version}"
    if reason == "length":
        return f"another length than {row.length} bytes"
    return "another publisher"
