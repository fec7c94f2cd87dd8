from __future__ import annotations

import asyncio
from collections.abc import Awaitable

import pytest

from eap.ads.endpoint import AmsAnswer, Endpoint
from eap.ads.operation import Operation, Read, ReadState, ReadWrite
from eap.ads.request import decode_outcome, encode_query
from eap.ams.report import HopQuestion, decode_report
from eap.codec.ads import IndexGroup
from eap.codec.ams import AmsHeader
from eap.ids import NetId
from eap.services.routing.service import LocalRequest
from eap.services.routing.tracing import RouteQuery
from tests.support.tracedplant import Line, to

WAY = Endpoint("link", "island-09")
TARGET = NetId.parse("5.1.1.2.3.1")
G = IndexGroup


class Rest:
    """Service behind: it records that it was called."""

    ports = frozenset((10_000,))

    def __init__(self) -> None:
        self.gone: list[Endpoint] = []

    def answer(self, request: LocalRequest) -> AmsAnswer:
        return AmsAnswer(b"rest" + bytes((request.header.command,)))

    def client_gone(self, endpoint: Endpoint) -> None:
        self.gone.append(endpoint)


def service(rest: Rest) -> RouteQuery:
    line = Line()
    station = line.add(1, to(2))
    line.add(2)
    return RouteQuery(station, rest)


def ask(operation: Operation) -> AmsAnswer:
    command, body = encode_query(operation)
    header = AmsHeader(NetId.parse("5.1.1.1.1.1"), 10_000, NetId.parse("9.9.9.9.1.1"), 1, command)

    async def get() -> AmsAnswer:
        answer = service(Rest()).answer(LocalRequest(header, body, WAY))
        return await answer if isinstance(answer, Awaitable) else answer

    return asyncio.run(get())


@pytest.mark.parametrize(("further", "station"), [(0, "island-01"), (1, "island-02")])
def test_hop_query_is_answered_or_forwarded(further: int, station: str) -> None:
    question = HopQuestion(TARGET, 1001, further)
    answer = ask(ReadWrite(G.ROUTE_QUERY, 0, 4096, question.encode()))
    outcome = decode_outcome(9, answer.error_code, answer.data)
    assert decode_report(outcome.data).station == station


@pytest.mark.parametrize(
    "operation",
    [
        ReadWrite(G.ROUTE_QUERY, 0, 4096, b"\5\1"),
        ReadWrite(G.ROUTE_QUERY, 0, 10, HopQuestion(TARGET, 1001).encode()),
    ],
)
def test_hop_query_of_wrong_size_is_an_error(operation: Operation) -> None:
    assert ask(operation).data == bytes.fromhex("05070000 00000000")


@pytest.mark.parametrize(
    "operation", [ReadState(), Read(G.ROUTE_QUERY, 0, 4), ReadWrite(G.SYMBOL_HANDLE, 0, 4, b"x")]
)
def test_other_requests_go_to_the_system_service(operation: Operation) -> None:
    assert ask(operation).data.startswith(b"rest")


def test_ports_and_clients_are_those_of_the_system_service() -> None:
    rest = Rest()
    here = service(rest)
    assert here.ports is rest.ports
    here.client_gone(WAY)
    assert rest.gone == [WAY]
