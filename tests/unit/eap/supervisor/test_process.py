"""The supervisor's start and its refusals; tests/integration has the rest of its life."""

from __future__ import annotations

import errno
import logging
import os
import signal
import socket
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from msgspec.structs import replace

from eap.config.load import Plant
from eap.config.web_sections import MetricsSection
from eap.errors import ConfigError, EnvironmentalError
from eap.ids import InterfaceUri, NetId
from eap.pd.device import DeviceState
from eap.pd.spec import BusPortSpec, PortKind, PortSpec, RxPdSpec, TxFrameSpec, TxPdSpec
from eap.runtime.folder import ApplianceFolder, find_appliances
from eap.runtime.handover import EngineOptions, Handover
from eap.runtime.store import StationStore, Stored, digest_of
from eap.supervisor import process as module
from eap.supervisor.child import Child
from eap.supervisor.process import (
    Supervisor,
    make_info,
    run,
)
from eap.supervisor.sockets import SharedSockets
from eap.supervisor.stored_start import find_build_errors, with_stored_configuration
from tests.support.eventually import wait_until
from tests.unit.eap.conftest import eap_port, left, right

DEMO = Path(__file__).parents[4] / "config" / "demo.yaml"


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / "run"))
    return tmp_path / "run"


def test_a_wrong_plant_is_refused_with_all_its_findings(tmp_path, root):
    plant = tmp_path / "plant.yaml"
    plant.write_text("plant: x\nstation: []\ncolour: red\n")
    with pytest.raises(ConfigError) as caught:
        run(plant)
    assert len(str(caught.value).splitlines()) > 1
    assert f"{plant}:2" in str(caught.value)
    assert not root.exists()


def test_an_unknown_station_is_refused_with_the_near_one(root):
    with pytest.raises(ConfigError, match="did you mean island-01"):
        run(DEMO, ["island-1"])
    with pytest.raises(ConfigError, match="it has island-01, island-02, island-03"):
        run(DEMO, ["x"])
    assert not root.exists()


def test_info_names_this_process(stations):
    info = make_info("demo", "/demo.yaml", stations)
    assert (info.supervisor, info.stations) == (os.getpid(), ["left", "right"])
    assert info.started_at.endswith("+00:00")


@pytest.mark.net
def test_a_child_that_cannot_start_ends_all_with_its_exit_code(stations, capfd):
    options = EngineOptions(realtime=False)
    with ApplianceFolder.claim("demo") as folder:
        with SharedSockets(folder.control_socket) as sockets:
            folder.image("left").mkdir()  # no image can be made here
            info = make_info("demo", "demo.yaml", stations)
            assert (
                Supervisor(info, Plant("x", stations), folder, sockets, options=options).run() == 2
            )
        engine, services = folder.read_info().engine.pid, folder.read_info().services.pid
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith("engine: ")
    assert len(err.splitlines()) == 1
    assert not Path(f"/proc/{engine}").exists()
    assert not Path(f"/proc/{services}").exists()
    assert find_appliances() == []


@pytest.mark.net
def test_a_segment_that_cannot_start_ends_all_with_its_exit_code(tmp_path, stations, capfd):
    bus_file = tmp_path / "bus.yaml"
    bus_file.write_text("bus: b\nslaves: []\n")
    bus = PortSpec(
        "bus0",
        PortKind.BUS,
        InterfaceUri.parse(f"sim://{bus_file}"),
        NetId.parse("1.1.1.1.1.9"),
        bus=BusPortSpec(str(bus_file)),
    )
    station = replace(stations[0], ports=(*stations[0].ports, bus))
    options = EngineOptions(realtime=False)
    with ApplianceFolder.claim("demo") as folder:
        with SharedSockets(folder.control_socket) as sockets:
            info = make_info("demo", "demo.yaml", [station])
            assert (
                Supervisor(info, Plant("x", (station,)), folder, sockets, options=options).run()
                == 2
            )
        assert list(folder.read_info().segments) == ["left/bus0"]
    out, err = capfd.readouterr()
    assert out == ""
    assert "segment: " in err
    assert "the bus has no slaves" in err


def end_when_all_run(folder: ApplianceFolder) -> None:
    """Ask this process to end as soon as engine and services run."""

    def do_all_run() -> bool:
        processes = (folder.read_info().engine, folder.read_info().services)
        return all(each.pid and not each.step for each in processes)

    try:
        wait_until(do_all_run, timeout_s=60)
    finally:
        os.kill(os.getpid(), signal.SIGTERM)


class FastClock:
    """Clock that is 400 times too fast until *is_enough*: no Python starts in 50 ms, then 20 s."""

    def __init__(self, is_enough: Callable[[], bool]) -> None:
        self._is_enough = is_enough
        self._real_ns = self._now_ns = time.monotonic_ns()

    def __call__(self) -> int:
        real_ns = time.monotonic_ns()
        self._now_ns += (real_ns - self._real_ns) * (2 if self._is_enough() else 400)
        self._real_ns = real_ns
        return self._now_ns


@pytest.mark.net
def test_supervisor_gives_children_that_got_stuck_more_time_and_never_gives_up(
    stations, caplog, capfd
):
    def stuck() -> list[str]:
        return [line for line in caplog.messages if " is stuck: " in line]

    options = EngineOptions(realtime=False)
    info = make_info("demo", "demo.yaml", stations)
    with (
        ApplianceFolder.claim("demo") as folder,
        SharedSockets(folder.control_socket) as sockets,
        ThreadPoolExecutor(1) as other,
    ):
        supervisor = Supervisor(
            info, Plant("x", stations), folder, sockets, options=options,
            clock=FastClock(lambda: len(stuck()) >= 3),
        )  # fmt: skip
        folder.write_info(info)
        other.submit(end_when_all_run, folder)
        assert supervisor.run() == 0
    assert '"ready":true' in capfd.readouterr().out
    wanted = "no progress for 20 s; it is killed and started again, with 40 s for each step"
    assert stuck()[0].endswith(wanted)


def hold_when_it_runs(folder: ApplianceFolder, *names: str) -> None:
    """Hold processes when all run, and end this one when others have taken their place."""

    def pids() -> list[int]:
        info = folder.read_info()
        own = {"engine": info.engine, "services": info.services, **info.extras}
        return [own[name].pid if name in own and not own[name].step else 0 for name in names]

    try:
        wait_until(lambda: all(pids()), timeout_s=60)
        held = pids()
        for pid in held:
            os.kill(pid, signal.SIGSTOP)
        wait_until(lambda: all(new and new not in held for new in pids()), timeout_s=60)
    finally:
        os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.net
def test_supervisor_replaces_processes_that_hang(stations, caplog, capfd, monkeypatch):
    monkeypatch.setattr(module, "LIFE_CHECK_NS", 800_000_000)  # signs come each second
    options = EngineOptions(realtime=False)
    info = make_info("demo", "demo.yaml", stations)
    plant = Plant("x", stations, metrics=MetricsSection(listen="127.0.0.1:29464"))
    with (
        ApplianceFolder.claim("demo") as folder,
        SharedSockets(folder.control_socket) as sockets,
        ThreadPoolExecutor(1) as other,
    ):
        supervisor = Supervisor(info, plant, folder, sockets, options=options)
        folder.write_info(info)
        other.submit(hold_when_it_runs, folder, "engine", "services", "metrics")
        assert supervisor.run() == 0
        info = folder.read_info()
        assert [info.engine.restarts, info.services.restarts] == [1, 1]
        assert info.extras["metrics"].restarts == 1
    for name in ("engine", "services", "metrics"):
        wanted = f"{name} hangs: no sign of life for 20 s; it is killed and started again"
        assert wanted in caplog.messages
    assert '"ready":true' in capfd.readouterr().out


def test_supervisor_tries_again_when_a_process_that_ran_cannot_be_started(
    stations, caplog, monkeypatch
):
    def fail(self, *_):
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    with (
        ApplianceFolder.claim("demo") as folder,
        SharedSockets(folder.control_socket) as sockets,
    ):
        options = EngineOptions(realtime=False)
        info = make_info("demo", "demo.yaml", stations)
        supervisor = Supervisor(info, Plant("x", stations), folder, sockets, options=options)
        monkeypatch.setattr(Child, "start", fail)
        engine = supervisor._engine
        with pytest.raises(EnvironmentalError, match="engine cannot be started"):
            supervisor._start(engine)
        engine.watch.begin(0)
        engine.watch.succeed()
        for _ in range(2):
            supervisor._start(engine)
        assert engine in supervisor._restart_ns
    assert "trying again in 100 ms" in caplog.messages[-1]


def test_process_that_starts_again_after_a_pause_is_started_once(stations, monkeypatch):
    started = []

    def start(self, *_):
        started.append(self.name)

    with (
        ApplianceFolder.claim("demo") as folder,
        SharedSockets(folder.control_socket) as sockets,
    ):
        options = EngineOptions(realtime=False)
        info = make_info("demo", "demo.yaml", stations)
        supervisor = Supervisor(
            info, Plant("x", stations), folder, sockets, options=options, clock=lambda: 0
        )
        monkeypatch.setattr(Child, "start", start)
        for child in (supervisor._engine, supervisor._services):
            supervisor._restart_ns[child] = 0
        for _ in range(3):
            supervisor._check_time()
    assert started == ["engine", "services"]


def handover():
    return Handover(1, "/run/x", "demo", "demo.yaml", (left(), right()), ())


@pytest.fixture
def sockets(tmp_path):
    with SharedSockets(tmp_path / "control") as sockets:
        yield sockets


def store(spec, state=DeviceState.OP):
    StationStore("demo", "left").configuration.save(
        Stored(base=digest_of(left()), spec=spec, state=state)
    )


@pytest.mark.net
def test_without_any_configuration_the_plant_file_runs(sockets):
    found = with_stored_configuration(handover(), sockets)
    states = {"left": DeviceState.OP, "right": DeviceState.OP}
    assert found == replace(handover(), states=states, sockets=sockets.fit((left(), right())))


@pytest.mark.net
def test_stations_that_start_in_preop(sockets):
    store(left(), DeviceState.SAFEOP)
    found = with_stored_configuration(replace(handover(), first_state=DeviceState.PREOP), sockets)
    assert found.states == {"left": DeviceState.SAFEOP, "right": DeviceState.PREOP}


@pytest.mark.net
def test_stored_configuration_runs_in_requested_state(sockets):
    changed = replace(left(), frames=())
    store(changed, DeviceState.SAFEOP)
    found = with_stored_configuration(handover(), sockets)
    assert found.stations == (changed, right())
    assert found.states == {"left": DeviceState.SAFEOP, "right": DeviceState.OP}


@pytest.mark.net
def test_stored_configuration_with_other_ports_runs(sockets):
    moved = left(eap_port(9))
    store(moved)
    found = with_stored_configuration(handover(), sockets)
    assert found.stations == (moved, right())
    assert found.sockets == sockets.fit((moved, right()))
    assert "127.9.2.1" not in {each.address for each in found.sockets}


@pytest.mark.net
def test_stored_configuration_whose_socket_is_in_use_does_not_run(sockets, caplog):
    store(left(eap_port(9)), DeviceState.SAFEOP)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as squatter:
        squatter.bind(("127.9.2.9", 34980))
        found = with_stored_configuration(handover(), sockets)
    assert found.stations == (left(), right())
    (line,) = caplog.messages
    assert line.startswith("station left: the plant file runs: UDP 127.9.2.9:34980 is in use")


@pytest.mark.net
def test_socket_of_the_plant_file_in_use_is_refused(sockets):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as squatter:
        squatter.bind(("127.9.2.2", 34980))
        with pytest.raises(EnvironmentalError, match=r"127\.9\.2\.2:34980 is in use"):
            with_stored_configuration(handover(), sockets)


@pytest.mark.net
def test_stored_configuration_that_cannot_be_built_does_not_run(caplog, sockets):
    store(replace(left(), variables=()))
    with caplog.at_level(logging.WARNING):
        found = with_stored_configuration(handover(), sockets)
    assert found.stations == (left(), right())
    assert "station left: the plant file runs: it cannot be built: KeyError" in caplog.text


BUS = PortSpec("bus0", PortKind.BUS, InterfaceUri.parse("sim://x.yaml"), NetId.parse("1.2.3.4.6.1"))


@pytest.mark.net
def test_stored_configuration_without_its_bus_file_does_not_run(tmp_path, caplog, sockets):
    file = tmp_path / "bus.yaml"
    file.write_text("bus: b\nslaves: [{name: a, kind: coupler}]\n")
    bus = BusPortSpec(str(file), simulated="digest")
    port = replace(BUS, interface=InterfaceUri("sim", str(file)), bus=bus)
    changed = replace(left(), ports=(*left().ports, port))
    store(changed)
    given = replace(handover(), folder=str(tmp_path))
    assert with_stored_configuration(given, sockets).stations[0] == changed
    file.unlink()
    with caplog.at_level(logging.WARNING):
        assert with_stored_configuration(given, sockets).stations[0] == left()
    assert "station left: the plant file runs: port bus0: " in caplog.text
    ApplianceFolder(tmp_path).segment("digest").touch()
    assert with_stored_configuration(given, sockets).stations[0] == changed


def test_whatever_a_plant_file_says_can_be_built():
    for interface in ("udp://127.9.2.1", "ethernet://eth7", "tcp://127.9.2.1"):
        spec = left(eap_port(1, interface))
        assert find_build_errors(replace(spec, ports=(*spec.ports, BUS))) == []
    assert find_build_errors(right()) == []


def test_incompatible_sockets_are_reported():
    unknown = replace(right(), subscriptions=(RxPdSpec("a", "eap0", 1, ("nothing",)),))
    assert find_build_errors(unknown) == ["it cannot be built: KeyError: 'nothing'"]
    many = tuple(TxPdSpec(f"p{n}", n, ("name",)) for n in range(200))
    (reason,) = find_build_errors(
        replace(left(), frames=(TxFrameSpec("f", "eap0", "10.0.0.1", many),))
    )
    assert reason.startswith("it cannot be built: ")
