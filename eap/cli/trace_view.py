"""The way to a device as a table for people."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeAlias

from rich.console import RenderableType
from rich.text import Text

from eap.cli.table import Column, TextTable
from eap.cli.words import count, duration
from eap.codec.ads import AdsState

Row: TypeAlias = dict[str, Any]


def trace_tables(found: Row) -> Iterator[RenderableType]:
    """Yield the way, what it ends with, and what is wrong with it."""
    name = f" ({found['name']})" if found["name"] not in {"", found["target"]} else ""
    yield Text(f"{found['target']}{name} is {found['address']}")
    table = TextTable(
        Column("Hop", is_number=True),
        "Router",
        Column("NetID", rank=2),
        Column("There", is_number=True),
        Column("Part", rank=1, is_number=True),
        Column("Goes on", wraps=True),
    )
    for number, hop in enumerate(found["hops"], 1):
        times = (duration(hop["took_us"]), duration(hop["spent_us"]))
        table.add_row(str(number), hop["station"], hop["net_id"], *times, _onward(hop))
    answer = found["answer"]
    if answer is not None:
        table.add_row("", "target", "", duration(answer["took_us"]), "", _answer(answer))
    yield table
    for hop in found["hops"]:
        refused = [service for service, allowed in hop["may"].items() if allowed is False]
        if refused:
            yield Text(f"{hop['station']}: its access rules refuse {', '.join(refused)}")
    for hop in found["hops"]:
        if number := hop.get("interrupted"):  # an older appliance does not tell
            many = count(number, "subscription")
            text = f"{hop['station']}: {many} interrupted for {hop['interrupted_s']} s"
            yield Text(text, style="bold red")
    if found["why"]:
        yield Text(f"not reached: {found['why']}", style="bold red")


def _onward(hop: Row) -> str:
    if hop["opaque"]:
        return "says nothing of its routes"
    if not hop["route"]:
        return "has no route" if hop["why"] else "it is here"
    return f"{hop['route']}: {hop['door']} to {hop['address']} ({hop['state']})"


def _answer(answer: Row) -> str:
    if answer["error"]:
        return f"answers: {answer['text']}"
    known = AdsState._value2member_map_.get(answer["ads_state"])
    state = known.name if isinstance(known, AdsState) else answer["ads_state"]
    return f"answers: {state}, device state {answer['device_state']}"
