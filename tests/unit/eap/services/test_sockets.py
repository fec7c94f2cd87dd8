"""Packets from the sockets of an appliance: UDP, multicast, TCP."""

from __future__ import annotations

import asyncio
import os
import socket
import struct
from contextlib import ExitStack

import pytest
from msgspec.structs import replace

from eap.ams.spec import RoutingSpec
from eap.codec.ethercat import EAP_PORT
from eap.errors import EngineGoneError, EnvironmentalError
from eap.runtime.drop_counters import DropCounters
from eap.runtime.handover import NO_DESCRIPTOR, Handover
from eap.runtime.passing import receive_passed
from eap.runtime.store import StationStore
from eap.services.gateway.gateway_transport import GatewayTable
from eap.services.network import Network
from eap.services.routing.station_routes import StationRoutes
from eap.services.socket_table import SocketFollower, SocketTable
from eap.services.sockets import Transports
from eap.services.supervisor_link import SupervisorLink
from eap.services.transports.accepting import Listeners
from eap.services.transports.route_logins import RouteLogins
from eap.supervisor.sockets import SharedSockets
from tests.support import aoe
from tests.support.eventually import eventually
from tests.support.routing import station
from tests.unit.eap.conftest import eap_port, left, right

pytestmark = pytest.mark.net

GROUP = "239.9.2.1"
LEFT, RIGHT = "127.9.2.1", "127.9.2.2"


class Scene:
    """Stations behind their sockets, whose ports come and go."""

    def __init__(self, folder, resources, stations) -> None:
        names = [each.name for each in stations]
        self.supervisor = resources.enter_context(SharedSockets(folder / "control"))
        self.counters = resources.enter_context(DropCounters(folder / "counts", names))
        inherited = tuple(
            replace(each, **{
                name: os.dup(getattr(each, name))
                for name in ("engine_fd", "services_fd")
                if getattr(each, name) != NO_DESCRIPTOR
            })
            for each in self.supervisor.fit(stations)
        )  # fmt: skip
        handover = Handover(1, "", "", "", stations, inherited)
        self.routers = {
            each.name: station(str(each.ports[0].net_id), name=each.name) for each in stations
        }
        self.engine, ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        resources.enter_context(self.engine)
        resources.enter_context(ours)
        routes = {
            name: StationRoutes(router, RoutingSpec(), StationStore("plant", name).routes)
            for name, router in self.routers.items()
        }
        end = socket.socket(fileno=os.dup(self.supervisor.services_end))
        link = SupervisorLink(end)
        resources.callback(link.close)
        asyncio.get_running_loop().add_reader(self.supervisor, self.supervisor.serve)
        self.table = SocketTable(handover, link, ours)
        resources.callback(self.table.close)
        self.listeners = Listeners()
        network = Network(
            self.table,
            self.routers,
            routes,
            GatewayTable(),
            self.counters,
            self.listeners,
            ours,
            RouteLogins(),
        )
        self.transports = Transports(network)
        self.table.on_change.append(self.transports.follow)
        self.followers = {name: SocketFollower(self.table, name) for name in names}

    async def change(self, spec) -> None:
        """Have the ports of a station, as its keeper does."""
        await self.followers[spec.name].open(spec)
        await self.followers[spec.name].follow(spec)

    def listening(self) -> list[str]:
        return sorted(each.name for each in self.listeners.stats())


@pytest.fixture
def run_scene(tmp_path):
    """Runs a script while stations are behind their sockets."""

    def run(script, *stations):
        async def serve():
            with ExitStack() as resources:
                scene = Scene(tmp_path, resources, stations)
                serving = [
                    asyncio.ensure_future(each.serve())
                    for each in (*scene.routers.values(), scene.transports)
                ]
                try:
                    await script(scene)
                finally:
                    for task in serving:
                        task.cancel()
                    await asyncio.wait(serving)
                    scene.transports.close()
                    asyncio.get_running_loop().remove_reader(scene.supervisor)

        asyncio.run(serve())

    return run


@pytest.fixture
def script_on(run_scene):
    """Runs a script with the drop counters of stations behind their sockets."""
    return lambda script, *stations: run_scene(lambda scene: script(scene.counters), *stations)


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


def second(interface: str, **more):
    return replace(eap_port(9, interface, **more), name="eap1")


def transports_of(scene, name: str) -> set[str]:
    known = ("udp:eap0", "udp:eap1", "tcp:eap0", "tcp:eap1", "ams-tcp")
    return {each for each in known if each in scene.routers[name]._senders}


def test_port_comes_and_goes_while_others_stay_open(run_scene):
    one = left()
    both = replace(one, ports=(*one.ports, second("udp://127.9.2.19", join=("239.9.2.9",))))

    async def script(scene):
        before = scene.listening()
        with client() as requester:
            for _ in range(2):
                await scene.change(both)
                assert transports_of(scene, "left") == {
                    "udp:eap0", "udp:eap1", "tcp:eap0", "tcp:eap1", "ams-tcp"
                }  # fmt: skip
                assert len(scene.listening()) == len(before) + 2
                answer, _ = await ask(requester, ("127.9.2.19", EAP_PORT), "1.2.3.4.5.1")
                assert answer.data == b"\4cba"
                reader, writer = await asyncio.open_connection("127.9.2.19", 48898)
                await scene.change(one)
                assert await reader.read(1) == b""
                writer.close()
                assert transports_of(scene, "left") == {"udp:eap0", "tcp:eap0", "ams-tcp"}
                assert scene.listening() == before
                assert {each.address for each in scene.table.sockets} == {LEFT}
            assert (await ask(requester, (LEFT, EAP_PORT), "1.2.3.4.5.1"))[0].data == b"\4cba"

    run_scene(script, one)


def test_port_at_a_shared_address_goes_and_connections_of_the_other_stay(run_scene):
    one, lodger = left(), right(eap_port(2, f"udp://{LEFT}"))

    async def script(scene):
        reader, writer = await asyncio.open_connection(LEFT, 48898)
        await scene.change(replace(lodger, ports=(eap_port(2, "udp://127.9.2.12"),)))
        assert transports_of(scene, "right") == {"udp:eap0", "tcp:eap0", "ams-tcp"}
        await scene.change(replace(lodger, ports=()))
        assert transports_of(scene, "right") == set()
        assert transports_of(scene, "left") == {"udp:eap0", "tcp:eap0", "ams-tcp"}
        packet = aoe.packet("1.2.3.4.5.1", 4, b"abc")
        writer.write(struct.pack("<HI", 0, len(packet)) + packet)
        answer = await asyncio.wait_for(reader.readexactly(6 + 32), 5)
        assert answer[6 + 24 : 6 + 28] == bytes(4)  # no error
        writer.close()

    run_scene(script, one, lodger)


def test_socket_that_cannot_be_opened_changes_nothing(run_scene):
    one = left()
    wanted = replace(one, ports=(*one.ports, second("udp://127.9.2.19")))

    async def script(scene):
        before = scene.table.sockets
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as squatter:
            squatter.bind(("127.9.2.19", EAP_PORT))
            follower = scene.followers["left"]
            with pytest.raises(EnvironmentalError, match="in use"):
                await follower.open(wanted)
            await follower.discard()
        assert scene.table.sockets == before
        await scene.change(wanted)

    run_scene(script, one)


def test_engine_gets_its_sockets_again_and_again(run_scene):
    async def script(scene):
        for _ in range(2):
            scene.table.pass_to_engine(left())
            taken = receive_passed(scene.engine)
            assert taken is not None
            with taken[0] as sock:
                assert sock.getsockname() == (LEFT, EAP_PORT)
        scene.engine.close()
        with pytest.raises(EngineGoneError):
            scene.table.pass_to_engine(left())

    run_scene(script, left())
