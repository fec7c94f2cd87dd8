"""StaticRoutes files: the routes of a TwinCAT router, or of a router of .NET, as XML.

Beckhoff publishes no schema; the form is that of the files in its own examples (``TcConfig`` with
``RemoteConnections/Route`` and ``Mqtt``, and ``Local`` in those of the .NET router) and of what
users show.  ``Flags`` and ``Timeout`` are kept as they are written: the meaning of the flags and
the unit of the time are published nowhere.

Secrets (keys, passwords, pre-shared keys) are neither read nor written: a record says only that the
file has them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from eap.codec.xmlstream import XmlElement, XmlError, read_tree

TCP_IP = "TCP_IP"
"""Type of a route over AMS/TCP."""
MAX_ROUTES = 10_000
MQTT_PORT, MQTTS_PORT = 1883, 8883
_ROOT = "TcConfig"
_BESIDE = "RemoteConnections"
_MAX_KEPT = 32
"""Characters of ``Flags`` and ``Timeout``."""


class StaticRoute(NamedTuple):
    """One route, as the file has it: nothing is checked, and what is missing is empty."""

    name: str
    net_id: str
    address: str
    """Name or IP address of the host."""
    type: str = TCP_IP
    flags: str = ""
    timeout: str = ""
    is_unidirectional: bool = False
    security: str = ""
    """Names of the elements that protect the connection: ``Tls``, ``Psk``."""
    has_ca: bool = False
    """True if ``Tls`` names an authority (``Ca``)."""
    ignores_name: bool = False
    """True if the certificate need not name the host (``IgnoreCn``)."""


class StaticBroker(NamedTuple):
    """One MQTT broker, as the file has it; files of certificates by their paths."""

    address: str
    port: int
    topic: str
    user: str = ""
    ca: str = ""
    certificate: str = ""
    has_tls: bool = False
    has_psk: bool = False
    has_secret: bool = False
    """True if the file has a key or a password for it."""
    is_unidirectional: bool = False


class StaticRoutes(NamedTuple):
    """Content of a file."""

    routes: list[StaticRoute]
    brokers: list[StaticBroker]
    others: list[str]
    """Names of the elements beside them, such as ``Json``."""


def parse(xml: str | bytes) -> StaticRoutes:
    """Return the routes and brokers of a file in their order.

    Raises:
        ValueError: it is no such file, or one that wants more of its reader than to be read.
    """
    try:
        root = read_tree([xml], roots=(_ROOT,))
        connections = [each for part in root.iterfind(_BESIDE) for each in part.children]
        found = StaticRoutes(
            [_route(each) for each in connections if each.tag == "Route"],
            [_broker(each) for each in connections if each.tag == "Mqtt"],
            [each.tag for each in connections if each.tag not in {"Route", "Mqtt"}],
        )
    except XmlError as exc:
        place = f"line {exc.line}: " if exc.line else ""
        raise ValueError(f"{place}{exc}, expected {exc.expected}") from None
    if len(connections) > MAX_ROUTES:
        raise ValueError(f"it has {len(connections)} routes, expected at most {MAX_ROUTES}")
    return found


def dump(
    name: str,
    net_id: str,
    routes: Iterable[StaticRoute],
    brokers: Iterable[StaticBroker] = (),
    *,
    tcp_port: int,
) -> str:
    """Return a file with *routes* for the router *name* that has *net_id* and listens there."""
    lines = [
        '<?xml version="1.0" encoding="utf-8"?>',
        f"<{_ROOT}>",
        "  <Local>",
        f"    {_element('Name', name)}",
        f"    {_element('NetId', net_id)}",
        f"    <TcpPort>{tcp_port}</TcpPort>",
        "  </Local>",
        f"  <{_BESIDE}>",
        *(f"    {line}" for route in routes for line in _route_lines(route)),
        *(f"    {line}" for broker in brokers for line in _broker_lines(broker)),
    ]
    return "\n".join([*lines, f"  </{_BESIDE}>", f"</{_ROOT}>", ""])


def _route(element: XmlElement) -> StaticRoute:
    tls = element.find("Tls")
    return StaticRoute(
        element.findtext("Name"),
        element.findtext("NetId"),
        element.findtext("Address"),
        element.findtext("Type") or TCP_IP,
        # Kept unread, therefore cut: the file may be of anyone.
        element.findtext("Flags")[:_MAX_KEPT],
        element.findtext("Timeout")[:_MAX_KEPT],
        element.attribute_flag("Unidirectional"),
        ", ".join(tag for tag in ("Tls", "Psk") if element.find(tag) is not None),
        bool(element.findtext("Tls/Ca")),
        tls is not None and tls.attribute_flag("IgnoreCn"),
    )


def _broker(element: XmlElement) -> StaticBroker:
    address, tls, psk = (element.find(tag) for tag in ("Address", "Tls", "Psk"))
    usual = MQTT_PORT if tls is None and psk is None else MQTTS_PORT
    secrets = ("Password", "Tls/Key", "Tls/KeyPwd", "Psk/Pwd")
    return StaticBroker(
        "" if address is None else address.text,
        usual if address is None else address.attribute_number("Port", 1, 0xFFFF, usual),
        element.findtext("Topic"),
        element.findtext("User"),
        element.findtext("Tls/Ca"),
        element.findtext("Tls/Cert"),
        tls is not None,
        psk is not None,
        # The import says that a secret has to be given again, without ever having it.
        any(element.findtext(path) for path in secrets),
        element.attribute_flag("Unidirectional"),
    )


def _route_lines(route: StaticRoute) -> Iterator[str]:
    yield f"<Route{_direction(is_unidirectional=route.is_unidirectional)}>"
    yield f"  {_element('Name', route.name)}"
    yield f"  {_element('Address', route.address)}"
    yield f"  {_element('NetId', route.net_id)}"
    yield f"  {_element('Type', route.type)}"
    if route.flags:
        yield f"  {_element('Flags', route.flags)}"
    if route.timeout:
        yield f"  {_element('Timeout', route.timeout)}"
    yield "</Route>"


def _broker_lines(broker: StaticBroker) -> Iterator[str]:
    yield f"<Mqtt{_direction(is_unidirectional=broker.is_unidirectional)}>"
    yield f'  <Address Port="{broker.port}">{_escaped(broker.address)}</Address>'
    yield f"  {_element('Topic', broker.topic)}"
    if broker.user:
        yield f"  {_element('User', broker.user)}"
    if broker.has_tls:
        files = (("Ca", broker.ca), ("Cert", broker.certificate))
        inner = "".join(_element(tag, path) for tag, path in files if path)
        yield f"  <Tls>{inner}</Tls>"
    yield "</Mqtt>"


def _direction(*, is_unidirectional: bool) -> str:
    return ' Unidirectional="true"' if is_unidirectional else ""


def _element(tag: str, text: str) -> str:
    return f"<{tag}>{_escaped(text)}</{tag}>"


def _escaped(text: str) -> str:
    from xml.sax.saxutils import escape  # services hardly ever writes one

    return escape(text)
