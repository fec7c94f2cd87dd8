"""A decoded frame as a tree for people: one line a frame, its parts below."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any, TypeAlias

from rich.text import Text
from rich.tree import Tree

Fields: TypeAlias = dict[str, Any]

_NAMES = {
    1: "datagrams",
    2: "AMS",
    3: "raw I/O",
    4: "process data",
    5: "mailbox",
}
_SHOWN_OCTETS = 32


def frame_tree(fields: Fields, origin: Fields) -> Tree:
    """Return the tree of what ``decode_frame`` found and how the frame came."""
    tree = Tree(Text(_headline(fields, origin), style="bold"), guide_style="dim")
    for line in _parts(fields):
        tree.add(Text(line))
    if fields["error"] is not None:
        tree.add(Text(f"error: {fields['error']}", style="red"))
    return tree


def _headline(fields: Fields, origin: Fields) -> str:
    parts = []
    if "packet" in origin:
        at = datetime.fromtimestamp(origin["time"], UTC)
        parts.append(f"#{origin['packet']} {at:%H:%M:%S.%f}")
    if origin:
        vlan = f" VLAN {origin['vlan_id']}" if "vlan_id" in origin else ""
        parts.append(f"{origin['transport']}{vlan} {origin['source']} → {origin['destination']}")
    if fields["type"] is None:
        return "  ".join([*parts, "no frame"])
    name = _NAMES.get(fields["type"], "undocumented")
    parts.append(f"type {fields['type']} ({name}), {fields['length']} octets")
    if fields.get("publisher") is not None:
        parts.append(f"publisher {fields['publisher']}, cycle {fields['cycle']}")
    return "  ".join(parts)


def _parts(fields: Fields) -> Iterator[str]:
    for pd in fields.get("pds", ()):
        yield (
            f"PD {pd['id']} (0x{pd['id']:04x})  version {pd['version']}  "
            f"quality {pd['quality'] / 10:g} ms  {_octets(pd['data'])}"
        )
    for datagram in fields.get("datagrams", ()):
        yield _datagram(datagram)
    if message := fields.get("mailbox"):
        data = "" if "ams" in message else f"  {_octets(message['data'])}"
        yield (
            f"{message['protocol']}  address {message['address']}  counter {message['counter']}  "
            f"priority {message['priority']}{data}"
        )
        if "reason" in message:
            yield f"refused: {message['reason']} (0x{message['detail']:04x})"
    if packet := fields.get("ams") or (fields.get("mailbox") or {}).get("ams"):
        yield _ams(packet)
    if "data" in fields:
        yield _octets(fields["data"])


def _datagram(datagram: Fields) -> str:
    if "address" in datagram:
        where = f"address 0x{datagram['address']:08x}"
    else:
        where = f"ADP 0x{datagram['adp']:04x}  ADO 0x{datagram['ado']:04x}"
    return (
        f"{datagram['command']}  index {datagram['index']}  {where}  WKC {datagram['wkc']}  "
        f"{_octets(datagram['data'])}"
    )


def _ams(packet: Fields) -> str:
    direction = "response" if packet["state_flags"] & 1 else "request"
    return (
        f"AMS {packet['service']} {direction} {packet['invoke_id']}  "
        f"{packet['source']}:{packet['source_port']} → "
        f"{packet['target']}:{packet['target_port']}  error 0x{packet['error_code']:x}  "
        f"{_octets(packet['data'])}"
    )


def _octets(digits: str) -> str:
    size = len(digits) // 2
    pairs = " ".join(digits[at : at + 2] for at in range(0, min(size, _SHOWN_OCTETS) * 2, 2))
    more = f" … ({size} octets)" if size > _SHOWN_OCTETS else ""
    return f"[{pairs}{more}]"
