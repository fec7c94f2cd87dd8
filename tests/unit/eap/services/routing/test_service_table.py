"""Which service answers."""

from __future__ import annotations

import pytest

from eap.ads.endpoint import AmsAnswer, Endpoint
from eap.codec.ams import AmsCommand, AmsHeader
from eap.ids import NetId
from eap.services.routing.service import ServiceTable
from tests.support.routing import StubService, echo

ROUTER, DEVICE = NetId.parse("1.1.1.1.1.1"), NetId.parse("1.1.1.1.2.1")


class Ready(StubService):
    """It has the answer at hand, none, or an error."""

    def __init__(self, ready: AmsAnswer | Exception | None, *ports: int) -> None:
        super().__init__(echo, *ports)
        self.ready = ready

    def answer_now(self, header: AmsHeader, body: bytes) -> AmsAnswer | None:
        if isinstance(self.ready, Exception):
            raise self.ready
        return self.ready


def request(port: int, target: NetId = DEVICE) -> AmsHeader:
    return AmsHeader(target, port, ROUTER, 33000, AmsCommand.READ)


@pytest.fixture
def table() -> ServiceTable:
    return ServiceTable((ROUTER, DEVICE))


def test_first_that_has_the_port_answers(table) -> None:
    one, other, of_router = StubService(echo, 1, 2), StubService(echo, 2, 3), StubService(echo, 4)
    for net_id, service in ((DEVICE, one), (DEVICE, other), (ROUTER, of_router)):
        table.add(net_id, service)
    assert [table.find(request(port)) for port in (1, 2, 3, 4)] == [one, one, other, None]
    assert table.find(request(4, ROUTER)) is of_router
    assert [port in table.ports(DEVICE) for port in (1, 3, 4)] == [True, True, False]
    other.ports.add(4)
    assert 4 in table.ports(DEVICE)
    assert table.find(request(4)) is other
    assert set(table.net_ids) == {ROUTER, DEVICE}
    with pytest.raises(KeyError):
        table.add(NetId.parse("9.9.9.9.9.9"), one)


def test_immediate_answer_comes_with_its_time(table) -> None:
    answer = AmsAnswer(b"now")
    table.add(DEVICE, Ready(answer, 1))
    found, took_ns = table.answer_now(request(1), b"")
    assert found is answer
    assert 0 < took_ns < 1_000_000_000


@pytest.mark.parametrize(
    "service", [StubService(echo, 1), Ready(None, 1), Ready(ValueError("oh"), 1), StubService(echo)]
)
def test_requests_without_immediate_answer_return_none(table, service) -> None:
    table.add(DEVICE, service)
    assert table.answer_now(request(1), b"") is None


def test_client_gone_notifies_all_services(table) -> None:
    services = [StubService(), StubService()]
    table.add(ROUTER, services[0])
    table.add(DEVICE, services[1])
    table.client_gone(Endpoint("tcp", "1"))
    assert [each.gone for each in services] == [[Endpoint("tcp", "1")]] * 2
