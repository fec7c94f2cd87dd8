"""Buses of services that come and go with the specifications of their stations."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path

import pytest
from msgspec.structs import replace

from eap.errors import EnvironmentalError
from eap.ids import InterfaceUri, NetId
from eap.pd.spec import BusPortSpec, GatewaySpec, PortKind, PortSpec, StationSpec
from eap.runtime.handover import PortName
from eap.runtime.passing import PassedLine, receive_passed
from eap.runtime.socket_plan import bus_of
from eap.services.bus_table import BusFollower, BusTable
from eap.services.engine_link import EngineLink
from tests.support.fakeengine import FakeBus, FakeEngine
from tests.support.loopbus import LoopBus
from tests.support.routing import station as router

pytestmark = pytest.mark.net

NET_ID = NetId.parse("5.1.1.1.1.1")
BUS = PortSpec(
    "bus0",
    PortKind.BUS,
    InterfaceUri.parse("sim:///x.yaml"),
    NetId.parse("5.1.1.1.3.1"),
    bus=BusPortSpec("/x.yaml", simulated="slaves"),
)
OWNER = PortName("left", "bus0")


def spec(*ports: PortSpec) -> StationSpec:
    return StationSpec("left", NET_ID, 10_000, ports)


class FakeSupervisor:
    """Opens pairs; *fault* is the reason that it does not."""

    def __init__(self) -> None:
        self.fault = ""
        self.kept: list[set[str]] = []
        self._numbers: dict[object, int] = {}

    async def open_bus(self, wanted):
        if self.fault:
            raise EnvironmentalError(self.fault)
        number = self._numbers.setdefault(wanted.key, len(self._numbers))
        engine, command = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return replace(
            wanted.key, number=number, engine_fd=engine.detach(), command_fd=command.detach()
        )

    def keep_buses(self, station, buses):
        self.kept.append({each.owner.port for each in buses})


class Bench:
    """A table with one station and the engine's end of its link for descriptors."""

    def __init__(self) -> None:
        self.engine = FakeEngine(FakeBus(LoopBus("drive")), FakeBus(LoopBus("coe")))
        self.link = EngineLink(self.engine.services)
        self.supervisor = FakeSupervisor()
        self.router = router(str(NET_ID))
        passing, self.passed = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._passing = passing
        self.gateways: list[PortName] = []
        self.specs = {"left": spec()}
        self.table = BusTable(
            self.link,
            passing,
            self.supervisor,
            {"left": self.router},
            lambda owner, gateway: self.gateways.append(owner),
        )
        self.table.start([spec()], [])
        self.follower = BusFollower(self.table, "left", self.specs)

    async def change(self, new: StationSpec) -> None:
        await self.follower.open(new)
        self.table.pass_to_engine(new)  # in front of each request to the engine
        self.specs["left"] = new
        await self.follower.follow(new)

    def lines(self) -> list[PassedLine]:
        """Return what was passed to the engine since the last call."""
        found = []
        while (received := receive_passed(self.passed)) is not None:
            sock_fd, passed = received
            sock_fd.close()
            found.append(passed)
        return found

    async def close(self) -> None:
        await self.table.close()
        self.link.close()
        self.engine.close()
        self._passing.close()
        self.passed.close()


def run(scene):
    async def main() -> None:
        bench = Bench()
        try:
            await scene(bench)
        finally:
            await bench.close()

    before = len(list(Path("/proc/self/fd").iterdir()))
    asyncio.run(main())
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_bus_that_is_added_is_passed_to_the_engine_and_served():
    async def scene(bench: Bench) -> None:
        await bench.change(spec(BUS))
        (line,) = bench.lines()
        assert line == PassedLine(replace(bus_of("left", BUS), number=0))
        assert list(bench.table.clients) == list(bench.table.segments) == [OWNER]
        assert list(bench.table.gateways.by_port) == bench.gateways == [OWNER]
        assert BUS.net_id in bench.router.net_ids
        assert (await bench.table.clients[OWNER].describe()).slaves
        assert bench.supervisor.kept == [{"bus0"}]

    run(scene)


def test_bus_that_is_removed_is_closed():
    async def scene(bench: Bench) -> None:
        await bench.change(spec(BUS))
        client = bench.table.clients[OWNER]
        await client.view.current()
        await bench.change(spec())
        assert bench.table.clients == bench.table.segments == {}
        assert bench.table.gateways.by_station == {}
        assert BUS.net_id not in bench.router.net_ids
        assert client.view.latest.fault == "the bus was removed from the plant"
        assert bench.supervisor.kept[-1] == set()
        assert not bench.link.on_change
        assert not bench.link.on_unsolicited

    run(scene)


@pytest.mark.parametrize(
    ("change", "number"),
    [
        ({"net_id": NetId.parse("5.1.1.1.9.1")}, 0),
        ({"gateway": GatewaySpec(full=True)}, 0),
        ({"bus": BusPortSpec("/x.yaml", simulated="other slaves")}, 1),
    ],
)
def test_services_of_a_changed_bus_are_opened_anew(change, number):
    async def scene(bench: Bench) -> None:
        await bench.change(spec(BUS))
        before, _ = bench.table.clients[OWNER], bench.lines()
        await bench.change(spec(replace(BUS, **change)))
        assert bench.table.clients[OWNER] is not before
        assert [line.bus.number for line in bench.lines()] == [number]
        assert bench.table.clients[OWNER].view.latest.fault == "no report from the engine yet"

    run(scene)


def test_bus_with_other_settings_keeps_its_services():
    async def scene(bench: Bench) -> None:
        await bench.change(spec(BUS))
        before, _ = bench.table.clients[OWNER], bench.lines()
        bus = BusPortSpec("/x.yaml", clocks=True, simulated="slaves")
        await bench.change(spec(replace(BUS, bus=bus, gateway=GatewaySpec(answer_ms=50))))
        assert bench.table.clients[OWNER] is before
        assert bench.table.gateways.by_port[OWNER].settings.answer_s == 0.05
        assert [line.bus.number for line in bench.lines()] == [0]

    run(scene)


def test_change_that_is_refused_leaves_nothing_open():
    async def scene(bench: Bench) -> None:
        await bench.follower.open(spec(BUS))
        await bench.follower.discard()
        assert bench.table.clients == {}
        assert bench.supervisor.kept == [set()]
        bench.supervisor.fault = "no such interface"
        with pytest.raises(EnvironmentalError, match="no such interface"):
            await bench.follower.open(spec(BUS))
        bench.supervisor.fault = ""
        interface = InterfaceUri.parse("ethernet://eth0")
        other = StationSpec("right", NET_ID, 10_000, (replace(BUS, interface=interface),))
        bench.specs["right"] = other
        with pytest.raises(EnvironmentalError, match="is the interface of"):
            await bench.follower.open(spec(replace(BUS, interface=interface)))
        await bench.follower.discard()

    run(scene)
