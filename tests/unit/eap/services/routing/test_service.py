"""Services, senders and the local client of a station."""

from __future__ import annotations

import asyncio
from inspect import signature

import pytest

from eap.codec.ads import AdsError
from eap.codec.ams import AmsAnswer, AmsCommand, AmsHeader
from eap.ids import Endpoint, NetId
from eap.services.ads.ads_service import AdsService
from eap.services.routing.service import LocalClient, Service, ServiceTable, TransportSender
from eap.services.transports.ams_tcp import AmsClients
from eap.services.transports.mailbox_frames import ChannelSender
from eap.services.transports.mailbox_stream import MailboxStreams
from tests.support import aoe
from tests.support.routing import RecordingSender, StubService, echo, station, while_serving
from tests.support.virtualtime import run_virtual


@pytest.mark.parametrize("service", [AdsService, StubService])
def test_services_have_the_methods_of_the_protocol(service):
    for method in ("answer", "client_gone"):
        asked = [*signature(getattr(Service, method)).parameters]
        assert [*signature(getattr(service, method)).parameters] == asked


@pytest.mark.parametrize(
    "sender", [AmsClients, ChannelSender, RecordingSender, LocalClient, MailboxStreams]
)
def test_senders_have_the_method_of_the_protocol(sender):
    assert [*signature(sender.send).parameters] == [*signature(TransportSender.send).parameters]


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


TARGET = NetId.parse("1.1.1.1.2.1")


def test_requests_side_by_side_get_their_own_answers():
    async def slow(request):
        for _ in range(request.body[0]):
            await asyncio.sleep(0)
        return echo(request)

    there = station(reply=slow)

    async def script():
        return await asyncio.gather(
            *(there.request(TARGET, 0xFFFF, aoe.READ, bytes([n]), timeout_s=1) for n in (9, 5, 1))
        )

    answers = run_virtual(while_serving(script(), there))
    assert answers == [AmsAnswer(bytes([0, 0, 0, 0, 2, n])) for n in (9, 5, 1)]
    assert there.record.connections.snapshot() == {}


def test_errors_are_answers():
    there = station()

    async def script():
        return [
            await there.request(TARGET, 1, aoe.READ, timeout_s=1),
            await there.request(NetId.parse("9.9.9.9.9.9"), 1, aoe.READ, timeout_s=1),
        ]

    answers = run_virtual(while_serving(script(), there))
    assert [each.error_code for each in answers] == [6, 7]


def test_local_client_time_out_is_an_error_and_drops_the_late_answer():
    access_filter = asyncio.Event()

    async def slow(request):
        await access_filter.wait()
        return AmsAnswer()

    there = station(reply=slow)

    async def script():
        answer = await there.request(TARGET, 0xFFFF, aoe.READ, timeout_s=0.01)
        access_filter.set()
        await asyncio.sleep(0)
        return answer

    assert run_virtual(while_serving(script(), there)) == AmsAnswer(error_code=AdsError.TIMEOUT)
    assert there.stats().in_flight == 0
