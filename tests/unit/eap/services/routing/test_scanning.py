from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import pytest

from eap.ads.device import AdsDevice
from eap.ads.io import IoDevice, IoDeviceType, IoSpace, MasterSpace, SlaveState
from eap.ads.notifications import AdsClient
from eap.ams.directory import Directory
from eap.ams.routes import Route
from eap.ams.spec import DirectoryPort, DirectoryStation
from eap.codec.ads import AdsDeviceInfo, AdsError, AdsState, AdsStates, device_name
from eap.codec.ams import IO_PORT, AmsAnswer
from eap.ids import Endpoint, InterfaceUri, NetId
from eap.services.routing import scanning
from eap.services.routing.scanning import scan, scan_targets
from tests.support.eventually import elapse
from tests.support.tracedplant import Line, Station, to
from tests.support.virtualtime import run_virtual

NOBODY = AdsClient(Endpoint("x", "1"), NetId(bytes(6)), 1)


class Master:
    def __init__(self, slaves: Sequence[SlaveState]) -> None:
        self._slaves = slaves

    def state(self) -> int:
        return 8

    def slaves(self) -> Sequence[SlaveState]:
        return self._slaves

    def request_state(self, state: int) -> None:
        raise AssertionError(state)

    def request_slave_state(self, address: int, state: int) -> None:
        raise AssertionError(address, state)


class Devices:
    """An I/O server, a master with two slaves, and the slaves, behind one function."""

    def __init__(self, number: int) -> None:
        net_id = NetId.parse(f"5.1.1.{number}.3.1")
        self.bus_is_up = True
        io = IoSpace(
            [
                IoDevice(1, "bus0", IoDeviceType.MASTER, net_id),
                IoDevice(2, "eap0", IoDeviceType.EAP, NetId.parse(f"5.1.1.{number}.2.1")),
            ]
        )
        self._io = self._device("io", io)
        states = [SlaveState(1001, 8, 0), SlaveState(1002, 0x14, 0)]
        self._master = self._device("master", MasterSpace(Master(states)))
        self._slave = self._device("coupler 7")

    def name_slaves(self, name: str) -> None:
        self._slave = self._device(name)

    def __call__(self, port: int, command: int, body: bytes) -> AmsAnswer:
        if port == IO_PORT:
            return self._io.answer(command, body, NOBODY, 0)
        if not self.bus_is_up:
            return AmsAnswer(error_code=AdsError.HOST_UNREACHABLE)
        device = self._slave if port < 0xFFFF else self._master
        return device.answer(command, body, NOBODY, 0)

    @staticmethod
    def _device(name: str, *spaces: Any) -> AdsDevice:
        info = AdsDeviceInfo(1, 0, 0, device_name(name))
        return AdsDevice(info, lambda: AdsStates(AdsState.RUN, 0), spaces)


def planned(number: int) -> DirectoryStation:
    return DirectoryStation(
        f"island-{number:02}",
        NetId.parse(f"5.1.1.{number}.1.1"),
        (
            DirectoryPort(
                "eap0",
                False,
                NetId.parse(f"5.1.1.{number}.2.1"),
                InterfaceUri.parse(f"udp://127.0.1.{number}"),
            ),
            DirectoryPort(
                "bus0",
                True,
                NetId.parse(f"5.1.1.{number}.3.1"),
                InterfaceUri.parse("sim://io.yaml"),
                {"drive": 1001},
            ),
        ),
    )


PLANT = Directory([planned(1), planned(2)])


def plant(*more: Route) -> tuple[Line, Station]:
    line = Line()
    first = line.add(1, to(2), *more, serve=Devices(1))
    line.add(2, to(1), serve=Devices(2))
    return line, first


def look(station: Station, directory: Directory = PLANT, *routes: Route) -> list[dict[str, Any]]:
    return msgspec.to_builtins(run_virtual(scan(station, scan_targets(directory, routes))))


def test_stations_ports_and_slaves_are_listed() -> None:
    _, first = plant()
    rows = look(first)
    assert [row["name"] for row in rows] == ["island-01", "island-02"]
    assert rows[1] == {
        "name": "island-02",
        "net_id": "5.1.1.2.1.1",
        "ports": [
            {
                "name": "eap0",
                "kind": "eap",
                "net_id": "5.1.1.2.2.1",
                "interface": "udp://127.0.1.2",
                "slaves": [],
                "error": "",
            },
            {
                "name": "bus0",
                "kind": "bus",
                "net_id": "5.1.1.2.3.1",
                "interface": "sim://io.yaml",
                "slaves": [
                    {"address": 1001, "name": "drive", "state": "OP"},
                    {"address": 1002, "name": "coupler 7", "state": "SAFEOP+ERROR"},
                ],
                "error": "",
            },
        ],
        "error": "",
    }


def test_scan_dead_station_is_listed_as_in_the_plant_file() -> None:
    line, first = plant()
    line.dead.add("island-02")
    here, dead = look(first)
    assert not here["error"]
    assert dead["error"] == (
        "island-02: it does not answer island-01 at island-02 by link:"
        " error 0x719 (no answer in time)"
    )
    assert dead["ports"][1]["slaves"] == [{"address": 1001, "name": "drive", "state": None}]


def test_a_bus_that_is_down_says_so() -> None:
    line, first = plant()
    devices = line.stations["island-02"].serve
    assert isinstance(devices, Devices)
    devices.bus_is_up = False
    _, far = look(first)
    assert not far["error"]
    bus = far["ports"][1]
    assert bus["error"] == "5.1.1.2.3.1:65535: error 0x1b (host unreachable)"
    assert bus["slaves"] == [{"address": 1001, "name": "drive", "state": None}]


def test_scan_lists_stations_that_only_routes_lead_to() -> None:
    line, first = plant(to(3), to(4))
    line.add(3, serve=Devices(3))
    line.dead.add("island-04")
    rows = look(first, PLANT, to(2), to(3), to(4))
    assert [row["name"] for row in rows] == ["island-01", "island-02", "island-03", "island-04"]
    names = [slave["name"] for slave in rows[2]["ports"][1]["slaves"]]
    assert names == ["coupler 7", "coupler 7"]
    assert rows[3]["ports"] == []
    assert rows[3]["error"].startswith("island-04: it does not answer island-01 at island-04")


def test_scan_station_behind_a_dead_one_names_the_dead_one() -> None:
    line, first = plant(to(3, 2))
    line.add(3, serve=Devices(3))
    line.dead |= {"island-02", "island-03"}
    rows = look(first, PLANT, to(2), to(3, 2))
    assert [row["error"].partition(":")[0] for row in rows] == ["", "island-02", "island-02"]


def test_default_routes_are_no_stations() -> None:
    everything = Route(NetId(bytes(6)), "default", Endpoint("link", "x"), octets=0)
    assert [each.name for each in scan_targets(Directory([]), [everything, to(3)])] == ["island-03"]


def test_scan_slow_station_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scanning, "STATION_TIMEOUT_S", 0.05)

    class Slow(Station):
        async def request(self, *args: Any, **more: Any) -> AmsAnswer:
            await elapse(0.02)
            return await super().request(*args, **more)

    line = Line()
    slow = Slow(line, 1, [], Devices(1))
    (row, _) = look(slow)
    assert row["error"] == "no complete answer within 0.05 s"
    assert [port["name"] for port in row["ports"]] == ["eap0", "bus0"]


def test_names_that_cannot_be_printed() -> None:
    line, first = plant()
    devices = line.stations["island-02"].serve
    assert isinstance(devices, Devices)
    devices.name_slaves("\x1b[2Jx")
    _, far = look(first)
    assert far["ports"][1]["slaves"][1]["name"] == "?[2Jx"
