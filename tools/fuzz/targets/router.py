"""Packets for a router: no exception, and no answer without a request."""

from __future__ import annotations

from eap.ams.access import AccessList
from eap.ams.router import Router
from eap.ams.routes import Route, RouteTable
from eap.ams.spec import AccessRule, ObjectRange
from eap.ams.transport_table import Deliver, Forward, Reply, Transport
from eap.codec.ams import AmsAnswer, AmsHeader, decode_packet
from eap.ids import Endpoint, NetId
from tools.fuzz.messages import cut

_OWN = NetId.parse("5.1.1.1.1.1")
_FAR = NetId.parse("6.1.1.1.1.1")
_CLIENTS = (Endpoint("tcp", "1"), Endpoint("segment", "2"))
_LINK = Endpoint("link", "6")
_NET_IDS = (_OWN, _FAR, NetId.parse("6.1.1.1.9.9"), NetId.parse("9.9.9.9.9.9"))
_OBJECTS = AccessRule("objects", objects=(ObjectRange(0, 0x7FFF),))
_CLIENT_IDS = (NetId.parse("7.1.1.1.1.1"), NetId.parse("7.1.1.1.1.2"), _OWN, _FAR)


def fuzz_one(data: bytes) -> None:
    """Give the router *data* whole; then cut, with addresses that lead somewhere."""
    router = Router(
        _OWN,
        RouteTable([Route(_FAR, "far", _LINK)]),
        [
            Transport("tcp", is_stream=True),
            Transport("segment", max_size=60),
            Transport("link", max_size=200),
        ],
        first_invoke_id=1,
        access=AccessList([AccessRule("wide", transports=("tcp",)), _OBJECTS]),
    )
    router.add_device(_OWN, {1, 2, 3})
    _feed(router, data, _CLIENTS[0])
    for message in cut(data):
        for endpoint in _CLIENTS:
            _feed(router, message, endpoint)
        if message:
            _feed(router, _addressed(message), _CLIENTS[message[0] >> 7])
    router.handle_timeout(1 << 40)
    router.connection_closed(*_CLIENTS[0], 1 << 40)
    router.handle_timeout(1 << 41)
    if router.stats().in_flight:
        raise AssertionError("a request waits for ever")


def _addressed(message: bytes) -> bytes:
    choice, body = message[0], message[5:]
    command = (2, 6, 7, 8, 9, 0x0902, 3, message[0])[choice >> 4 & 7]
    invoke_id = int.from_bytes(message[1:5], "little")
    target, source = _NET_IDS[choice & 3], _CLIENT_IDS[choice >> 2 & 3]
    header = AmsHeader(target, choice & 3, source, 5, command, 4, len(body), 0, invoke_id)
    return header.encode() + body


def _feed(router: Router, data: bytes, endpoint: Endpoint) -> None:
    for action in router.receive_packet(data, *endpoint, 0):
        if isinstance(action, Reply):
            if action.endpoint != endpoint:
                raise AssertionError(f"an answer for {action.endpoint}, which asked nothing")
        elif isinstance(action, Deliver):
            router.receive_answer(action.ticket, AmsAnswer(b"that"), 0)
        else:
            _answer(router, action, data)


def _answer(router: Router, action: Forward, data: bytes) -> None:
    """Answer what went on: with the octets of the fuzzer behind a proper header."""
    header, _ = decode_packet(action.packets[0])
    back = AmsHeader(
        header.source, header.source_port, header.target, header.target_port, header.command,
        header.state_flags | 1, len(data), 0, header.invoke_id,
    )  # fmt: skip
    for _ in range(2):
        router.receive_packet(back.encode() + data, *_LINK, 0)
