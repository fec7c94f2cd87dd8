"""What a new specification would change at a station, in words, and what it cannot change.

Pure: nothing here runs anything.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from eap.appliance.change import needs_new_start
from eap.device.pdlayout import bus_variables, kept_versions
from eap.pd.spec import LinkSpec, Source, StationSpec, VariableSpec


def find_refusals(old: StationSpec, new: StationSpec) -> list[str]:
    """Return what cannot change while the station runs; nothing else may be done then."""
    before = {port.name: port.net_id for port in old.ports}
    net_ids = [("the station's router", old.net_id, new.net_id)]
    net_ids += [
        (f"port {port.name}", before[port.name], port.net_id)
        for port in new.ports
        if port.name in before
    ]
    return needs_new_start(old, new) + [
        f"{what}: net_id {was} -> {becomes}: this needs a new start of the appliance"
        for what, was, becomes in net_ids
        if was != becomes
    ]


def describe_rest(old: StationSpec, new: StationSpec) -> list[str]:
    """Return what changes beside the objects of the dictionaries, a line for each thing."""
    on_bus = bus_variables(old) | bus_variables(new)
    return [
        *kept_versions(old, new),
        *_differences("source of", _source_name, old.sources, new.sources),
        *_differences("link", _link_name, old.links, new.links),
        *_differences("variable", _variable_name, _chosen(old, on_bus), _chosen(new, on_bus)),
    ]


def _chosen(spec: StationSpec, names: set[str]) -> tuple[VariableSpec, ...]:
    return tuple(each for each in spec.variables if each.name in names)


def _source_name(source: Source) -> str:
    return source.variable


def _link_name(link: LinkSpec) -> str:
    bits = f" bit {link.source_bit}" if link.source_bit else ""
    target_bits = f" bit {link.target_bit}" if link.target_bit else ""
    return f"{link.source}{bits} to {link.target}{target_bits}"


def _variable_name(variable: VariableSpec) -> str:
    return variable.name


def _differences(
    what: str, name_of: Callable[[Any], str], old: tuple[Any, ...], new: tuple[Any, ...]
) -> Iterator[str]:
    before = {name_of(each): each for each in old}
    after = {name_of(each): each for each in new}
    for name in before:
        if name not in after:
            yield f"{what} {name}: removed"
    for name, each in after.items():
        if name not in before:
            yield f"{what} {name}: added"
        elif before[name] != each:
            yield f"{what} {name}: changed"
