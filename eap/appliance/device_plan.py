"""What a new specification would change at a station, in words, and what it cannot change.

Pure: nothing here runs anything.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from eap.device.eap_content import bus_variables
from eap.pd.spec import LinkSpec, PortSpec, Source, StationSpec, VariableSpec

RESTART = "needs a new start of the appliance"


def find_refusals(old: StationSpec, new: StationSpec) -> list[str]:
    """Return what cannot change while the station runs; nothing else may be done then."""
    found = [
        f"{field} {getattr(old, field)} would become {getattr(new, field)}: it {RESTART}"
        for field in ("name", "net_id")
        if getattr(old, field) != getattr(new, field)
    ]
    before = {port.name: port for port in old.ports}
    after = {port.name: port for port in new.ports}
    found += [f"port {name} would go: it {RESTART}" for name in before if name not in after]
    for name, port in after.items():
        if name not in before:
            found.append(f"port {name} would be new: it {RESTART}")
        else:
            found += _port_differences(before[name], port)
    return found


def describe_rest(old: StationSpec, new: StationSpec) -> list[str]:
    """Return what changes beside the objects of the dictionaries, a line for each thing."""
    on_bus = bus_variables(old) | bus_variables(new)
    return [
        *_differences("source of", _source_name, old.sources, new.sources),
        *_differences("link", _link_name, old.links, new.links),
        *_differences("variable", _variable_name, _chosen(old, on_bus), _chosen(new, on_bus)),
    ]


def _port_differences(old: PortSpec, new: PortSpec) -> Iterator[str]:
    for field in msgspec.structs.fields(PortSpec):
        before, after = getattr(old, field.name), getattr(new, field.name)
        if before == after:
            continue
        if field.name == "bus":
            yield f"port {old.name}: its bus would change: that {RESTART}"
        else:
            told = f"{field.name} {_text(before)} would become {_text(after)}"
            yield f"port {old.name}: {told}: that {RESTART}"


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "none"
    return str(value)


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
