"""StaticRoutes files: the routes of a TwinCAT router, or of a router of .NET, as XML.

Beckhoff publishes no schema; the form is that of the files in its own examples (``TcConfig`` with
``RemoteConnections/Route``, and ``Local`` in those of the .NET router) and of what users show.
Of a route ``Name``, ``Address``, ``NetId`` and ``Type`` are read; ``Flags`` and ``Timeout`` are
about TwinCAT's own connection, so they are not.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

TCP_IP = "TCP_IP"
"""Type of a route over AMS/TCP."""
MAX_ROUTES = 10_000
_ROOT = "TcConfig"
_BESIDE = "RemoteConnections"


class StaticRoute(NamedTuple):
    """One route, as the file has it: nothing is checked, and what is missing is empty."""

    name: str
    net_id: str
    address: str
    """Name or IP address of the host."""
    type: str = TCP_IP


def parse(xml: str | bytes) -> list[StaticRoute]:
    """Return the routes of a file in their order.

    Raises:
        ValueError: it is no such file, or one that wants more of its reader than to be read.
    """
    from defusedxml import ElementTree  # services, which hardly ever reads one, starts without
    from defusedxml.common import DefusedXmlException

    try:
        root: Element = ElementTree.fromstring(xml)
    except DefusedXmlException:
        raise ValueError("it declares entities, expected plain elements") from None
    except (SyntaxError, ValueError, LookupError) as exc:
        raise ValueError(f"not XML that can be read: {exc}") from None
    if root.tag != _ROOT:
        raise ValueError(f"it begins with {root.tag!r}, expected {_ROOT}")
    found = list(root.iterfind(f"{_BESIDE}/Route"))
    if len(found) > MAX_ROUTES:
        raise ValueError(f"it has {len(found)} routes, expected at most {MAX_ROUTES}")
    return [_route(each) for each in found]


def dump(name: str, net_id: str, routes: Iterable[StaticRoute], *, tcp_port: int) -> str:
    """Return a file with *routes* for the router *name* that has *net_id* and listens there."""
    from xml.sax.saxutils import escape

    lines = [
        '<?xml version="1.0" encoding="utf-8"?>',
        f"<{_ROOT}>",
        "  <Local>",
        f"    <Name>{escape(name)}</Name>",
        f"    <NetId>{escape(net_id)}</NetId>",
        f"    <TcpPort>{tcp_port}</TcpPort>",
        "  </Local>",
        f"  <{_BESIDE}>",
    ]
    for route in routes:
        lines += [
            "    <Route>",
            f"      <Name>{escape(route.name)}</Name>",
            f"      <Address>{escape(route.address)}</Address>",
            f"      <NetId>{escape(route.net_id)}</NetId>",
            f"      <Type>{escape(route.type)}</Type>",
            "    </Route>",
        ]
    return "\n".join([*lines, f"  </{_BESIDE}>", f"</{_ROOT}>", ""])


def _text(element: Element, tag: str) -> str:
    return (element.findtext(tag) or "").strip()


def _route(element: Element) -> StaticRoute:
    name, net_id, address = (_text(element, tag) for tag in ("Name", "NetId", "Address"))
    return StaticRoute(name, net_id, address, _text(element, "Type") or TCP_IP)
