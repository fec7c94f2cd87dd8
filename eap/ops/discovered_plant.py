"""The text of a plant file that subscribes to discovered process data.

Each PD goes to the port that its frames reach: one port for each address on UDP, one for each VLAN
on Ethernet.  Addresses of this host and groups belong to the station ``here``; an address of
another host belongs to a station of its own, which runs on that host alone.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from ipaddress import IPv4Address
from typing import NamedTuple

from eap.net.interface import own_addresses
from eap.ops.discover import DiscoveredPd

_HERE = "here"
_MIN_CYCLE_US, _MAX_CYCLE_US = 100, 60_000_000
_MAX_STEP = 0xFFFF
_ANY = "0.0.0.0"  # noqa: S104  a port that takes what comes to any address of its host
_UNKNOWN_INTERFACE = "eth0"


_WORD = re.compile(
    r"(?!(?:true|false|null|yes|no|on|off)$)[A-Za-z][\w-]*", re.ASCII | re.IGNORECASE
)
"""Texts that any version of YAML reads as they are."""


class _PortKey(NamedTuple):
    """Port that PDs arrive at."""

    station: str
    interface: str
    vlan_id: int


def discovered_plant(
    name: str, rows: Sequence[DiscoveredPd], interface: str = ""
) -> tuple[str, int]:
    """Return a plant file with a subscription for each PD, and the number of subscriptions.

    Args:
        name: Of the plant.
        rows: The PDs.
        interface: At which they were seen; empty for a capture file.
    """
    ports: dict[_PortKey, dict[tuple[str, int], DiscoveredPd]] = {}
    left_out: list[str] = []
    own = {address for label, address in own_addresses() if label.partition(":")[0] == interface}
    # The layout seen most often first: a port takes one layout of a PD.
    for row in sorted(rows, key=lambda row: -row.received):
        if not row.length:
            left_out.append(f"{_label(row)} has no data")
            continue
        if not row.transport:
            left_out.append(f"{_label(row)}: no frame shows where it arrives")
            continue
        taken = ports.setdefault(_port_of(row, interface, own), {})
        if row.key in taken:
            left_out.append(f"{_label(row)} comes to the same port in another layout")
        else:
            taken[row.key] = row
    lines = list(_text(name, ports, left_out, interface))
    return "\n".join(lines) + "\n", sum(map(len, ports.values()))


def _port_of(row: DiscoveredPd, interface: str, own: set[str]) -> _PortKey:
    if row.transport == "ethernet":
        # A unicast address may be that of this host or of another one: the frame does not say.
        uri = f"ethernet://{interface or _UNKNOWN_INTERFACE}"
        return _PortKey(_HERE, uri, row.vlan_id or 0)
    host, _, number = row.destination.partition(":")
    suffix = f":{number}" if number else ""
    if row.destination_kind != "unicast":
        address = min(own, default=_ANY)
        return _PortKey(_HERE, f"udp://{address}{suffix}", 0)
    is_here = host in own or IPv4Address(host).is_loopback
    scheme = "tcp" if row.transport == "tcp" else "udp"
    return _PortKey(_HERE if is_here else f"at-{host}", f"{scheme}://{host}{suffix}", 0)


def _text(
    name: str,
    ports: dict[_PortKey, dict[tuple[str, int], DiscoveredPd]],
    left_out: Iterable[str],
    interface: str,
) -> Iterator[str]:
    where = f"at interface {interface}" if interface else "in a capture"
    yield f"# Process data seen {where} by 'eapctl discover': a subscription for each PD."
    yield "# It sends nothing.  Types are blocks of bytes until the publisher's types are known;"
    yield "# 'looks like' is a guess from the bytes."
    for each in left_out:
        yield f"# Left out: {each}."
    yield f"plant: {_scalar(name)}"
    yield "stations:"
    stations = list(dict.fromkeys(key.station for key in ports))
    publishers = {pd.publisher for taken in ports.values() for pd in taken.values()}
    prefix = _free_prefix(publishers)
    for number, station in enumerate(sorted(stations, key=lambda each: (each != _HERE, each)), 1):
        keys = sorted((key for key in ports if key.station == station), key=_port_order)
        if station != _HERE:
            yield f"  # Frames to {station.removeprefix('at-')} reach that host only: run it there."
        yield f"  - name: {station}"
        yield f"    net_id: {prefix}.{number}.1.1"
        yield "    ports:"
        for at, key in enumerate(keys):
            yield f"      - {_port(at, key, f'{prefix}.{number}.2.{at + 1}', ports[key])}"
        yield "    subscribe:"
        names = Counter(_pd_name(row) for key in keys for row in ports[key].values())
        for at, key in enumerate(keys):
            for row in sorted(ports[key].values(), key=_row_order):
                suffix = f"-{row.pd_id}-eap{at}" if names[_pd_name(row)] > 1 else ""
                yield from _subscription(f"eap{at}", row, _pd_name(row) + suffix)


def _port_order(key: _PortKey) -> list[int | str]:
    return [_number(part) for part in re.split(r"(\d+)", key.interface)] + [key.vlan_id]


def _row_order(row: DiscoveredPd) -> tuple[list[int], int]:
    return [int(part) for part in row.publisher.split(".")], row.pd_id


def _number(part: str) -> int | str:
    return int(part) if part.isdecimal() else part


def _free_prefix(publishers: Iterable[str]) -> str:
    """Return three numbers that no publisher's NetID begins with."""
    used = {tuple(each.split(".")[:3]) for each in publishers}
    first = next(n for n in range(255, 0, -1) if ("10", "254", str(n)) not in used)
    return f"10.254.{first}"


def _port(number: int, key: _PortKey, net_id: str, pds: dict[tuple[str, int], DiscoveredPd]) -> str:
    rows = pds.values()
    parts = [f"name: eap{number}", "kind: eap", f'interface: "{key.interface}"']
    parts.append(f"net_id: {net_id}")
    if key.vlan_id:
        parts.append(f"vlan: {{id: {key.vlan_id}}}")
    if key.interface.startswith(("udp", "tcp")):
        # Nothing but process data: AMS would take the ports of a router on this host.
        parts.append("ams: false")
    groups = sorted({_host(row) for row in rows if row.destination_kind == "multicast"})
    if groups:
        parts.append(f"join: [{', '.join(map(_scalar, groups))}]")
    if key.interface.startswith("udp") and any(row.destination_kind == "broadcast" for row in rows):
        parts.append("broadcast: true")
    if any(row.header_length is not None for row in rows):
        parts.append("length: lenient")
    return f"{{{', '.join(parts)}}}"


def _host(row: DiscoveredPd) -> str:
    return row.destination if row.transport == "ethernet" else row.destination.partition(":")[0]


def _pd_name(row: DiscoveredPd) -> str:
    return f"{row.name or f'pd{row.pd_id}'}-{row.publisher}"


def _subscription(port: str, row: DiscoveredPd, name: str) -> Iterator[str]:
    source = [f"publisher: {row.publisher}", f"id: {row.pd_id}"]
    if row.trigger == "cycle" and row.cycle_order == "little" and row.step:
        cycle_us = row.sender_cycle_us or 0
        if _MIN_CYCLE_US <= cycle_us <= _MAX_CYCLE_US and row.step <= _MAX_STEP:
            source += [f"cycle_us: {cycle_us}", f"step: {row.step}"]
    yield f"      # {_label(row)}: {_sent(row)}"
    for text in row.looks_like if row.variables is None else ():
        yield f"      # looks like {text}"
    yield f"      - name: {_scalar(name)}"
    yield f"        port: {port}"
    yield f"        from: {{{', '.join(source)}}}"
    yield "        foreign: true"
    if row.version:
        yield f"        version: {row.version}"
    yield "        variables:"
    for variable, kind in _variables(row):
        yield f"          {_scalar(f'{name}.{variable}')}: {_scalar(kind)}"


def _variables(row: DiscoveredPd) -> list[tuple[str, str]]:
    if row.variables is None:
        return [("data", f"BLOCK({row.length})")]
    return [(each.name, each.type) for each in row.variables]


def _label(row: DiscoveredPd) -> str:
    vlan = "" if row.vlan_id is None else f", VLAN {row.vlan_id}"
    return (
        f"PD {row.pd_id} of {row.publisher} (version {row.version}, {row.length} bytes) "
        f"to {row.destination}{vlan}"
    )


def _sent(row: DiscoveredPd) -> str:
    if row.trigger == "cycle":
        return f"every {row.period_ms:g} ms"
    if row.trigger is None:
        return f"seen {row.received} times"
    return f"{row.trigger.replace('_', ' ')}, {row.rate_hz or 0:.3g} a second"


def _scalar(text: str) -> str:
    """Return *text* as YAML reads it back: quoted unless it is plainly a word."""
    return text if _WORD.fullmatch(text) else json.dumps(text)
