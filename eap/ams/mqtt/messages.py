"""Messages of AMS over MQTT: topics, payloads, the info of a router, and ports of its clients.

All routers of a network have topics that begin with its name and their NetID (Beckhoff
ADS-over-MQTT): ``…/info`` holds the info of a router, requests come by ``…/ams``, answers and
notifications by ``…/ams/res``.  The info is a little XML,
``<info><online name="HOST" osVersion="…" osPlatform="…" tcVersion="…">true</online></info>``; with
``false`` the router is offline, which is also its last will.
"""

from __future__ import annotations

from collections import OrderedDict
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

from eap.codec.ams import AmsCommand, AmsHeader, AmsTcpHeader, StateFlags, encode_with_prefix
from eap.errors import MalformedError, TruncatedError
from eap.ids import NetId

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element


MAX_NETWORK = 128
"""Characters of the name of a network."""


class TopicKind(Enum):
    """Purpose of a topic; the value is its part behind the NetID."""

    INFO = "info"
    REQUESTS = "ams"
    ANSWERS = "ams/res"


class Topics:
    """Topics of one router in a network.

    Raises:
        ValueError: no network can have that name.

    Attributes:
        info: Topic of its own info.
        filters: Topic filters that it subscribes to.
    """

    def __init__(self, network: str, net_id: NetId) -> None:
        check_network(network)
        self._start = f"{network}/"
        self.info = self.of(str(net_id), TopicKind.INFO)
        self.all_info = self.of("+", TopicKind.INFO)
        self.filters = (f"{self._start}{net_id}/ams/#", self.all_info)

    def of(self, address: str, kind: TopicKind) -> str:
        """Return the topic of the router with the NetID *address*."""
        return f"{self._start}{address}/{kind.value}"

    def parse(self, topic: str) -> tuple[NetId, TopicKind] | None:
        """Return router and purpose of a topic; None for an unknown one."""
        if not topic.startswith(self._start):
            return None
        address, _, rest = topic[len(self._start) :].partition("/")
        kind = _KINDS.get(rest)
        try:
            net_id = NetId.parse(address)
        except ValueError:
            return None
        # Not 05.1.1.1.1.1: each router has one topic for one purpose.
        return (net_id, kind) if kind is not None and str(net_id) == address else None


def check_network(name: str) -> None:
    """Raise ValueError, and say why, if no network can have that name."""
    if not name or len(name) > MAX_NETWORK:
        raise ValueError(f"{name[:40]!r} is no name of a network: 1 to {MAX_NETWORK} characters")
    if not name.isprintable() or set(name) & set("+#"):
        raise ValueError(f"{name!r} is no name of a network: no '+', '#' or control characters")
    if name.startswith(("$", "/")) or name.endswith("/"):
        raise ValueError(f"{name!r} is no name of a network: no '$' or '/' in front, no '/' behind")


_KINDS = {kind.value: kind for kind in TopicKind}


class Payload(NamedTuple):
    """Packet of a message, and its form."""

    packet: bytes
    is_prefixed: bool


def decode_payload(payload: bytes) -> Payload:
    """Return the packet in a message.

    Raises:
        TruncatedError: there is not even a header.
    """
    start = AmsTcpHeader.SIZE
    if len(payload) >= start + AmsHeader.SIZE:
        prefix = AmsTcpHeader.decode(payload)
        # A prefix is 0 and the length of the rest; a bare packet begins with a NetID instead.
        if prefix.reserved == 0 and prefix.length == len(payload) - start:
            return Payload(payload[start:], is_prefixed=True)
    if len(payload) < AmsHeader.SIZE:
        text = f"{len(payload)} bytes, expected {AmsHeader.SIZE} or more"
        raise TruncatedError(text, layout="AmsHeader")
    return Payload(payload, is_prefixed=False)


def encode_payload(payload: Payload) -> bytes:
    """Return the message that carries a packet."""
    return encode_with_prefix(payload.packet) if payload.is_prefixed else payload.packet


MAX_INFO = 4096
"""Bytes; a longer info is refused."""
MAX_NAME = 64
_UNIX = 4
"""Number of the platform; 2, which routers on Windows have, is that of Windows NT."""
_WORDS = {"true": True, "false": False}


class Info(NamedTuple):
    """Info of a router."""

    name: str
    """Of its host; empty if the info has none."""
    is_online: bool
    is_unidirectional: bool = False
    """True if the router accepts no requests."""


def encode_info(info: Info) -> bytes:
    """Return the message that carries *info*."""
    from xml.sax.saxutils import quoteattr  # with urllib and email; only brokers get such messages

    more = ' unidirectional="true"' if info.is_unidirectional else ""
    word = "true" if info.is_online else "false"
    attributes = f'name={quoteattr(info.name)} osPlatform="{_UNIX}"{more}'
    return f"<info><online {attributes}>{word}</online></info>".encode()


def decode_info(payload: bytes) -> Info:
    """Return the info of a message; an empty message means that the router is offline.

    Raises:
        MalformedError: it is no such message, or longer than any.
    """
    if not payload:
        return Info("", is_online=False)
    online = _parse(payload).find("online")
    word = "" if online is None else (online.text or "").strip().lower()
    if online is None or word not in _WORDS:
        raise MalformedError(f"online is {word[:20]!r}, expected true or false", layout="info")
    name = "".join(filter(str.isprintable, online.get("name", ""))).strip()
    is_unidirectional = online.get("unidirectional", "").lower() == "true"
    return Info(name[:MAX_NAME], _WORDS[word], is_unidirectional)


def _parse(payload: bytes) -> Element:
    from defusedxml import ElementTree  # the plant file's checks read topics only

    if len(payload) > MAX_INFO:
        raise MalformedError(f"{len(payload)} bytes, expected at most {MAX_INFO}", layout="info")
    try:
        root: Element = ElementTree.fromstring(payload.rstrip(b"\0"), forbid_dtd=True)
    except (SyntaxError, ValueError, LookupError) as exc:
        text = str(exc)[:80] or type(exc).__name__
        raise MalformedError(f"this is not XML that is read: {text}", layout="info") from None
    if root.tag != "info":
        raise MalformedError(f"it begins with {root.tag[:20]!r}, expected 'info'", layout="info")
    return root


FIRST_PORT, LAST_PORT = 0xA000, 0xDFFF
"""Ports given out; nothing of a station has one of these."""
_TARGET, _SOURCE, _COMMAND, _FLAGS = slice(0, 8), slice(8, 16), slice(16, 18), slice(18, 20)
_COMES_BACK = frozenset({AmsCommand.NOTIFICATION.value, AmsCommand.FRAGMENT.value})


class ClientPorts:
    """AMS ports of clients; the port of the client silent for longest is reused.

    Args:
        net_id: Of the router.
    """

    def __init__(self, net_id: NetId) -> None:
        self._net_id = bytes(net_id)
        self._ports: OrderedDict[bytes, int] = OrderedDict()
        self._clients: dict[int, bytes] = {}

    def __len__(self) -> int:
        return len(self._ports)

    def to_network(self, packet: bytes) -> bytes:
        """Return a packet of a client as it is sent to other routers."""
        if not is_request(packet):
            return packet
        client = packet[_SOURCE]
        # The router itself needs no port of a client.
        if client[:6] == self._net_id and not _is_given(_port(client)):
            return packet
        source = self._net_id + self._port_of(client).to_bytes(2, "little")
        return packet[: _SOURCE.start] + source + packet[_SOURCE.stop :]

    def to_client(self, packet: bytes) -> bytes:
        """Return a packet of another router as its client gets it."""
        target = packet[_TARGET]
        client = self._clients.get(_port(target)) if target[:6] == self._net_id else None
        if client is None or not is_reply(packet):
            return packet
        self._ports.move_to_end(client)
        return client + packet[_TARGET.stop :]

    def _port_of(self, client: bytes) -> int:
        port = self._ports.get(client)
        if port is not None:
            self._ports.move_to_end(client)
            return port
        if len(self._ports) > LAST_PORT - FIRST_PORT:
            _, port = self._ports.popitem(last=False)
        else:
            port = FIRST_PORT + len(self._ports)
        self._ports[client] = port
        self._clients[port] = client
        return port


def is_request(packet: bytes) -> bool:
    """Return whether a packet is a request: neither an answer nor a notification."""
    command, flags = _number(packet, _COMMAND), _number(packet, _FLAGS)
    return not flags & StateFlags.RESPONSE and command != AmsCommand.NOTIFICATION


def is_reply(packet: bytes) -> bool:
    """Return whether a packet is an answer, a notification or a fragment."""
    is_response = _number(packet, _FLAGS) & StateFlags.RESPONSE
    return bool(is_response) or _number(packet, _COMMAND) in _COMES_BACK


def _number(packet: bytes, field: slice) -> int:
    return int.from_bytes(packet[field], "little")


def _port(address: bytes) -> int:
    return int.from_bytes(address[6:], "little")


def _is_given(port: int) -> bool:
    return FIRST_PORT <= port <= LAST_PORT
