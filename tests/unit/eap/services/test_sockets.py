"""Packets from the sockets of an appliance: UDP, multicast, TCP."""

from __future__ import annotations

import asyncio
import os
import socket
from contextlib import ExitStack

import pytest
from msgspec.structs import replace

from eap.ams.spec import RoutingSpec
from eap.codec.ethercat import EAP_PORT
from eap.runtime.drop_counters import DropCounters
from eap.runtime.handover import Handover
from eap.runtime.store import StationStore
from eap.services.gateway.gateway_transport import GatewayTable
from eap.services.routing.station_routes import StationRoutes
from eap.services.sockets import Network, open_transports
from eap.services.transports.accepting import Listeners
from eap.supervisor.sockets import SharedSockets
from tests.support import aoe
from tests.support.eventually import eventually
from tests.support.routing import station
from tests.unit.eap.conftest import eap_port, left, right

pytestmark = pytest.mark.net

GROUP = "239.9.2.1"
LEFT, RIGHT = "127.9.2.1", "127.9.2.2"


@pytest.fixture
def script_on(tmp_path):
    """Runs a script while stations are behind their sockets."""

    def run(script, *stations):
        async def serve():
            with ExitStack() as resources:
                names = [each.name for each in stations]
                sockets = resources.enter_context(SharedSockets(tmp_path / "control"))
                counters = resources.enter_context(DropCounters(tmp_path / "counts", names))
                handover = Handover(1, "", "", "", stations, sockets.fit(stations))
                handover = _with_own_descriptors(handover)
                routers = {
                    each.name: station(str(each.ports[0].net_id), name=each.name)
                    for each in stations
                }
                ours, theirs = socket.socketpair()
                resources.enter_context(ours)
                resources.enter_context(theirs)
                routes = {
                    name: StationRoutes(router, RoutingSpec(), StationStore("plant", name).routes)
                    for name, router in routers.items()
                }
                network = Network(
                    handover, routers, routes, GatewayTable(), counters, Listeners(), resources
                )
                transports = open_transports(network, ours)
                serving = [
                    asyncio.ensure_future(each.serve()) for each in (*routers.values(), *transports)
                ]
                try:
                    await script(counters)
                finally:
                    for task in serving:
                        task.cancel()
                    await asyncio.wait(serving)
                    _forget_readers()

        asyncio.run(serve())

    return run


def _with_own_descriptors(handover: Handover) -> Handover:
    """As another process has them: closing them closes nothing of the supervisor's."""
    sockets = tuple(
        replace(each, services_fd=os.dup(each.services_fd)) for each in handover.sockets
    )
    return replace(handover, sockets=sockets)


def _forget_readers() -> None:
    loop = asyncio.get_running_loop()
    for key in list(loop._selector.get_map().values()):
        if key.fd != loop._ssock.fileno():
            loop.remove_reader(key.fd)


def client(host: str = "127.0.0.1") -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind((host, 0))
    sock.setblocking(False)
    return sock


async def ask(sock: socket.socket, where: tuple[str, int], target: str):
    loop = asyncio.get_running_loop()
    sock.sendto(aoe.frame(aoe.packet(target, 4, b"abc")), where)
    data, sender = await asyncio.wait_for(loop.sock_recvfrom(sock, 2048), 5)
    return aoe.answer(data), sender


def test_udp_is_answered_from_its_own_port(script_on):
    async def script(counters):
        with client() as sock:
            answer, sender = await ask(sock, (LEFT, EAP_PORT), "1.2.3.4.5.1")
            assert answer.data == b"\4cba"
            assert sender == (LEFT, EAP_PORT)
            assert (await ask(sock, (LEFT, EAP_PORT), "1.2.3.4.5.2"))[0].error == 7
        assert counters.stats() == {"left": {}, "right": {}}

    script_on(script, left(), right())


def test_multicast_is_answered_by_the_station_that_is_meant(script_on):
    stations = [
        replace(make(eap_port(number, join=(GROUP,)))) for number, make in ((1, left), (2, right))
    ]

    async def script(counters):
        with client(LEFT) as sock:
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(LEFT))
            answer, sender = await ask(sock, (GROUP, EAP_PORT), "1.2.3.4.5.2")
            assert answer.error == 0
            assert sender == (RIGHT, EAP_PORT)
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(ask(sock, (GROUP, EAP_PORT), "9.9.9.9.9.9"), 0.2)

    script_on(script, *stations)


def test_tcp_is_answered(script_on):
    async def script(counters):
        reader, writer = await asyncio.open_connection(LEFT, EAP_PORT)
        writer.write(aoe.frame(aoe.packet("1.2.3.4.5.1", 4, b"abc")))
        writer.write_eof()
        answer = aoe.answer(await asyncio.wait_for(reader.read(), 5))
        assert answer.data == b"\4cba"
        writer.close()

    script_on(script, left())


def test_dropped_frame_is_counted_at_every_station(script_on):
    async def script(counters):
        with client() as sock:
            sock.sendto(aoe.frame(b"x" * 10, kind=3), (LEFT, EAP_PORT))
            await eventually(lambda: counters.stats()["left"])
        assert counters.stats() == {"left": {"mailbox": 1}}

    script_on(script, left())
