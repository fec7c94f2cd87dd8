"""Cost of an AoE router: a look-up among few and many routes, and a forwarded packet."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter_ns

from eap.ams.router import Router
from eap.ams.routes import Route, RouteTable
from eap.ams.transport_table import Forward, Transport
from eap.codec.ams import AmsCommand, AmsHeader, decode_packet, encode_packet
from eap.ids import Endpoint, NetId
from tools.bench.figures import Figure, at_most, report
from tools.bench.settings import Settings

TITLE = "AoE routing: look-up among 10 and 10,000 routes, a request and its answer through a router"
_CALLS = 5000
_FEW, _MANY = 10, 10_000
_FLAT = 1.5
_CLIENT, _HOP = Endpoint("tcp", "client"), Endpoint("link", "hop")
_TARGETS = 64
"""NetIDs looked up in turn."""


def run(settings: Settings) -> list[Figure]:
    """Measure look-ups and a whole exchange."""
    settings.tell("AoE routing")
    return [*_lookups(settings.micro_repeats), *_passages(settings.micro_repeats)]


def _lookups(repeats: int) -> list[Figure]:
    figures = []
    for name, octets in (("exact", 6), ("by four bytes", 4)):
        few, many = (
            _best(_lookup(_table(count), octets), repeats) / _TARGETS for count in (_FEW, _MANY)
        )
        detail = f"{few:.0f} and {many:.0f} ns"
        what = f"look-up {name}: {_MANY:,} routes, ratio to {_FEW}"
        figures.append(at_most(what, many / few, _FLAT, detail=detail))
    return figures


def _net_id(number: int) -> NetId:
    return NetId((5, number >> 16, number >> 8 & 0xFF, number & 0xFF, 1, 1))


def _table(count: int) -> RouteTable:
    return RouteTable([Route(_net_id(number), f"r{number}", _HOP) for number in range(count)])


def _lookup(table: RouteTable, octets: int) -> Callable[[], object]:
    count = len(table)
    targets = [_net_id(number * 7919 % count) for number in range(_TARGETS)]
    if octets < 6:
        targets = [NetId(target[:octets] + b"\7\7") for target in targets]
    find = table.find

    def look_up() -> None:
        for target in targets:
            find(target)

    return look_up


def _passages(repeats: int) -> list[Figure]:
    far = NetId.parse("6.1.1.1.1.1")
    head = AmsHeader(far, 851, NetId.parse("7.1.1.1.1.1"), 30000, AmsCommand.READ, invoke_id=1)
    request = encode_packet(head, bytes(12))
    answer = encode_packet(head, bytes(12))

    def code() -> None:
        for packet in (request, answer):
            encode_packet(*decode_packet(packet))

    bare = _best(code, repeats) / 2
    figures = []
    for count in (1, _MANY):
        table = _table(count - 1)
        table.add(Route(far, "far", _HOP))
        ours = _best(_exchange(table, request), repeats) / 2
        measured = f"{ours / 1000:.2f} us (decoded and encoded alone: {bare / 1000:.2f} us)"
        what = "a packet through a router" + (f" with {count:,} routes" if count > 1 else "")
        figures.append(report(what, measured, ours / 1000))
    return figures


def _exchange(table: RouteTable, request: bytes) -> Callable[[], object]:
    transports = [
        Transport("tcp", is_stream=True, is_hub=True),
        Transport("link", is_stream=True, is_hub=True),
    ]
    router = Router(NetId.parse("9.1.1.1.1.1"), table, transports, first_invoke_id=1)

    def exchange() -> None:
        (forward,) = router.receive_packet(request, *_CLIENT, 0)
        if not isinstance(forward, Forward):
            raise TypeError(f"the request did not go on: {forward}")
        packet = forward.packets[0]
        # The hop's part is cheap: addresses swapped, the flag of a response set.
        back = packet[8:16] + packet[:8] + packet[16:18] + b"\5\0" + packet[20:]
        router.receive_packet(back, *_HOP, 0)

    return exchange


def _best(call: Callable[[], object], repeats: int) -> float:
    """Return nanoseconds a call of the fastest run: what disturbs only ever makes it slower."""
    calls = _CALLS // 10
    return min(_timed(call, calls) for _ in range(repeats)) / calls


def _timed(call: Callable[[], object], calls: int) -> int:
    begin = perf_counter_ns()
    for _ in range(calls):
        call()
    return perf_counter_ns() - begin
