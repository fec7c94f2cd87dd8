"""The text of plant files that are made of imported stations, with comments for their readers."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from textwrap import wrap

from eap.config.imports.stations import (
    PlannedFrame,
    PlannedPd,
    PlannedPort,
    PlannedStation,
    PlannedSubscription,
    PlannedVariable,
)

_WIDTH = 100
_PLAIN = re.compile(r"(?!(?:true|false|null)$)[^\W\d_][\w-]*(?:/[\w-]+)*", re.IGNORECASE)
"""Texts that YAML reads as they are."""
_NET_ID = re.compile(r"\d+(?:\.\d+){5}", re.ASCII)


def plant_text(
    name: str,
    stations: Sequence[PlannedStation],
    types: Iterable[str] = (),
    *,
    head: Iterable[str] = (),
) -> str:
    """Return a plant file.

    Args:
        name: Name of the plant.
        stations: Its stations.
        types: Lines of the section of types; may be empty.
        head: Comments at the start.
    """
    lines = [
        *_comments(head, ""),
        f"plant: {scalar(name)}",
        "",
        *types,
        *([""] if types else []),
        "stations:",
    ]
    for station in stations:
        lines += station_lines(station)
        lines.append("")
    return "\n".join(lines[:-1]) + "\n"


def station_lines(station: PlannedStation) -> Iterator[str]:
    """Yield the lines of one station, as an item of the list of stations."""
    yield f"  - name: {scalar(station.name)}"
    yield from _comments(station.remarks, "    ")
    yield f"    net_id: {station.net_id}"
    yield f"    cycle_us: {station.cycle_us}"
    yield "    ports:"
    for port in station.ports:
        yield from _comments(port.remarks, "      ")
        yield f"      - {_port(port)}"
    if not station.ports:
        yield "      []"
    own = [pd.variable for frame in station.frames for pd in frame.pds]
    if variables := [*station.variables, *own]:
        yield "    variables:"
        for variable in variables:
            yield f"      {scalar(variable.name)}: {_variable(variable)}"
    if station.frames:
        yield from _frames(station.frames)
    if station.subscriptions:
        yield "    subscribe:"
        for each in station.subscriptions:
            comments = [*each.reasons, *each.remarks]
            yield from _entry(comments, _subscription(each), is_off=each.reasons)


def _frames(frames: Sequence[PlannedFrame]) -> Iterator[str]:
    yield "    frames:"
    for frame in frames:
        yield from _entry([*frame.reasons, *frame.remarks], _frame(frame), is_off=frame.reasons)
    yield "    publish:"
    for frame in frames:
        for pd in frame.pds:
            yield from _entry((), _pd(pd, frame), is_off=frame.reasons)


def scalar(text: str) -> str:
    """Return *text* as YAML writes it within a mapping in braces."""
    if _PLAIN.fullmatch(text) or _NET_ID.fullmatch(text):
        return text
    return json.dumps(text, ensure_ascii=False)


def _comments(texts: Iterable[str], indent: str) -> Iterator[str]:
    for text in texts:
        line = " ".join(text.split())
        prefix = f"{indent}# "
        yield from wrap(
            line,
            _WIDTH,
            initial_indent=prefix,
            subsequent_indent=prefix,
            break_long_words=False,
            break_on_hyphens=False,
        ) or [prefix.rstrip()]


def _entry(comments: Sequence[str], entry: str, *, is_off: Sequence[str]) -> Iterator[str]:
    yield from _comments(comments, "      ")
    yield f"      # - {entry}" if is_off else f"      - {entry}"


def _mapping(**values: str | int | bool) -> str:
    """Return a mapping in braces of the values that are given; all texts are YAML already."""
    parts = [
        f"{key.rstrip('_')}: {'true' if value is True else value}"
        for key, value in values.items()
        if value not in {"", 0}
    ]
    return f"{{{', '.join(parts)}}}"


def _port(port: PlannedPort) -> str:
    vlan_id, priority = port.vlan
    return _mapping(
        name=scalar(port.name),
        kind="bus" if port.bus else "eap",
        interface=json.dumps(port.interface, ensure_ascii=False),
        net_id=str(port.net_id),
        # The bus file of simulated slaves is their description.
        bus=scalar(port.bus) if port.bus and port.scheme != "sim" else "",
        clocks=port.clocks,
        mac=json.dumps(port.mac) if port.mac else "",
        vlan=f"{{id: {vlan_id}, priority: {priority}}}" if vlan_id else "",
        join=json.dumps(port.join) if port.join else "",
    )


def _variable(variable: PlannedVariable) -> str:
    if not variable.comment:
        return scalar(variable.type)
    return _mapping(type=scalar(variable.type), comment=scalar(variable.comment))


def _frame(frame: PlannedFrame) -> str:
    return _mapping(
        name=scalar(frame.name),
        port=scalar(frame.port),
        to=scalar(frame.to or "DESTINATION"),
        divider=frame.divider if frame.divider > 1 else 0,
        modulo=frame.modulo,
        monitor_interval_ms=frame.monitor_ms,
        changeable=frame.is_changeable,
    )


def _pd(pd: PlannedPd, frame: PlannedFrame) -> str:
    # An ID of 0 is as good as any other.
    return (
        f"{{name: {scalar(pd.name)}, frame: {scalar(frame.name)}, id: {pd.id}"
        + (f", version: {pd.version}" if pd.version else "")
        + (f", cycle_us: {pd.cycle_us}" if pd.cycle_us else "")
        + f", variables: [{scalar(pd.variable.name)}]}}"
    )


def _subscription(each: PlannedSubscription) -> str:
    numbers = f"{{publisher: {each.publisher or 'any'}, id: {each.id}}}"
    return _mapping(
        name=scalar(each.name),
        port=scalar(each.port),
        from_=scalar(each.source) if each.source else numbers,
        foreign=not each.source,
        version=0 if each.source else each.version,
        timeout_ms=each.timeout_ms,
        variables=f"{{{scalar(each.variable.name)}: {_variable(each.variable)}}}",
    )
