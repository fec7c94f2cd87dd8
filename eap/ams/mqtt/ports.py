"""Ports of the router that stand for clients behind it.

An answer by MQTT goes to the topic of the NetID that asked.  Clients of this router have NetIDs of
their own, for which nobody else has a topic; so what they ask is asked in the router's name, from
an AMS port of its own for each of them, and what comes back to that port is theirs.
"""

from __future__ import annotations

from collections import OrderedDict

from eap.codec.ams import AmsCommand, StateFlags
from eap.ids import NetId

FIRST_PORT, LAST_PORT = 0xA000, 0xDFFF
"""Ports given out; nothing of a station has one of these."""
_TARGET, _SOURCE, _COMMAND, _FLAGS = slice(0, 8), slice(8, 16), slice(16, 18), slice(18, 20)
_COMES_BACK = frozenset({AmsCommand.NOTIFICATION.value, AmsCommand.FRAGMENT.value})


class ClientPorts:
    """Which client has which port; the one silent for longest makes room.

    Args:
        net_id: Of the router.
    """

    def __init__(self, net_id: NetId) -> None:
        self._net_id = bytes(net_id)
        self._ports: OrderedDict[bytes, int] = OrderedDict()
        self._clients: dict[int, bytes] = {}

    def __len__(self) -> int:
        return len(self._ports)

    def outward(self, packet: bytes) -> bytes:
        """Return a packet of a client as it goes to others."""
        if not is_request(packet):
            return packet
        client = packet[_SOURCE]
        if client[:6] == self._net_id and not _is_given(_port(client)):
            return packet
        source = self._net_id + self._port_of(client).to_bytes(2, "little")
        return packet[: _SOURCE.start] + source + packet[_SOURCE.stop :]

    def inward(self, packet: bytes) -> bytes:
        """Return a packet of others as the client gets it that it is for."""
        target = packet[_TARGET]
        client = self._clients.get(_port(target)) if target[:6] == self._net_id else None
        if client is None or not comes_back(packet):
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
    """Say whether a packet asks something: neither an answer nor a notification."""
    command, flags = _number(packet, _COMMAND), _number(packet, _FLAGS)
    return not flags & StateFlags.RESPONSE and command != AmsCommand.NOTIFICATION


def comes_back(packet: bytes) -> bool:
    """Say whether a packet is, or may be, for who asked before."""
    is_response = _number(packet, _FLAGS) & StateFlags.RESPONSE
    return bool(is_response) or _number(packet, _COMMAND) in _COMES_BACK


def _number(packet: bytes, where: slice) -> int:
    return int.from_bytes(packet[where], "little")


def _port(address: bytes) -> int:
    return int.from_bytes(address[6:], "little")


def _is_given(port: int) -> bool:
    return FIRST_PORT <= port <= LAST_PORT
