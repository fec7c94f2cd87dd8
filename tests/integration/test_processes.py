"""The processes of an appliance: started, killed one by one, ended, and refused."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from eap.codec.ethercat import EAP_PORT, EtherCatHeader
from eap.codec.pd import PdFrameHeader, PdHeader, encode_frame
from eap.errors import ControlError
from eap.ids import NetId
from eap.ops.client import ControlClient, connect
from eap.runtime.folder import VARIABLE
from tests.support.appliance import Appliance, Plants, SharedAppliance, wait_until
from tests.support.machine import slowness

pytestmark = pytest.mark.net
IS_ABOUT_PROCESSES = True

PLANT = """\
plant: processes
defaults: {cycle_us: 5000}
stations:
  - name: left
    net_id: 127.9.1.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.1.1", net_id: 127.9.1.1.2.1, tcp: TCP}
    variables:
      ticks: UDINT
      load: REAL
      setpoint: UINT
    sources:
      ticks: {kind: counter}
      load: {kind: host, measure: cpu_percent, period_ms: 100}
    frames:
      - {name: out, port: eap0, to: right/eap0}
    publish:
      - {name: state, frame: out, id: 1, variables: [ticks, load, setpoint]}
  - name: right
    net_id: 127.9.1.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.1.2", net_id: 127.9.1.2.2.1}
    subscribe:
      - {name: left-state, port: eap0, from: left/state, timeout_ms: 100}
"""
TICKS, SETPOINT = "left-state.ticks", "left-state.setpoint"
LEFT = ("127.9.1.1", EAP_PORT)
FOREIGN_PD = encode_frame(
    PdFrameHeader(NetId.parse("9.9.9.9.9.9"), 1, 0), [(PdHeader(99, 0, 2), b"\1\2")]
)
MAILBOX = EtherCatHeader(6, 0, 5).encode() + bytes(6)


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> SharedAppliance:
    plant = module_farm.write(PLANT.replace("TCP", "true"))

    def begin() -> Appliance:
        wait_until(lambda: is_free(LEFT))
        appliance = module_farm.start(plant, runtime=module_farm.folder / "run")
        appliance.wait_ready()
        return appliance

    return SharedAppliance(begin)


@pytest.fixture
def appliance(shared: SharedAppliance, monkeypatch: pytest.MonkeyPatch) -> Appliance:
    """Return the appliance that tests share; its values arrive."""
    running = shared.running()
    monkeypatch.setenv(VARIABLE, str(running.runtime))
    wait_until(lambda: received() > 10)
    return running


@pytest.fixture
def alone(farm: Plants, monkeypatch: pytest.MonkeyPatch) -> Plants:
    """Return a farm with a plant file of other addresses, where nothing has run yet."""
    monkeypatch.setenv(VARIABLE, str(farm.folder / "run"))
    farm.write(PLANT.replace("TCP", "true").replace("127.9.1.", "127.9.3."))
    return farm


def start(farm: Plants, *arguments: str) -> Appliance:
    return farm.start(farm.folder / "plant.yaml", *arguments, runtime=farm.folder / "run")


def is_free(address: tuple[str, int]) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        try:
            trial.bind(address)
        except OSError:
            return False
    return True


def status() -> dict[str, Any]:
    (client,) = connect()
    with client:
        return client.request("status")


def station(document: dict[str, Any], name: str) -> dict[str, Any]:
    return next(s for s in document["stations"] if s["name"] == name)


def discarded(name: str = "left") -> dict[str, int]:
    return station(status(), name)["discarded"]


def received() -> int:
    return station(status(), "right")["pd"]["rx"][0]["received"]


def send(frame: bytes, count: int = 1) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for _ in range(count):
            sock.sendto(frame, LEFT)


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def assert_sorted_by_the_kernel() -> None:
    """Both processes get the frames of their own type, and no others."""
    before = discarded()
    send(FOREIGN_PD, 20)
    send(MAILBOX, 30)
    wait_until(lambda: discarded().get("mailbox", 0) >= before.get("mailbox", 0) + 30)
    wait_until(lambda: foreign(discarded()) >= foreign(before) + 20)
    assert discarded().get("wrong_type", 0) == 0


def foreign(counted: dict[str, int]) -> int:
    """Return how many PDs of others were counted."""
    return counted.get("wrong_publisher", 0) + counted.get("unknown_id", 0)


def test_life_of_an_appliance(alone: Plants) -> None:
    running = start(alone)
    assert running.wait_ready() == ["left", "right"]
    document = status()
    assert document["version"] == 1
    assert set(document["processes"]) == {"supervisor", "engine", "services"}
    pids = [process["pid"] for process in document["processes"].values()]
    assert pids[0] == running.process.pid
    for process in document["processes"].values():
        assert process["rss"] > 1_000_000
        assert process["cpu"] >= 0
    assert document["processes"]["engine"]["realtime"]["scheduler"]
    assert [s["state"] for s in document["stations"]] == ["OP", "OP"]
    assert station(document, "left")["ports"][0]["link"] == "up"
    wait_until(lambda: received() > 20)
    rx = station(status(), "right")["pd"]["rx"][0]
    assert (rx["lost"], rx["duplicated"], rx["reordered"]) == (0, 0, 0)

    start_s = time.monotonic()
    code, out, err = running.stop()
    assert time.monotonic() - start_s < 2 * slowness()
    assert (code, out, err) == (0, "", "")
    assert not any(map(is_running, pids))
    assert list(running.runtime.iterdir()) == []


def test_values_move_and_can_be_set(appliance: Appliance) -> None:
    (client,) = connect(station="right")
    with client:
        assert client.request("write", station="left", values={"setpoint": 77}) == {"written": 1}
        events = client.events(station="right", names=[TICKS, SETPOINT], period_ms=20)
        seen = [next(events).values for _ in range(10)]
        assert seen[-1][TICKS] > seen[0][TICKS]
        assert seen[-1][SETPOINT] == 77
    (other,) = connect()
    with other:
        loads = [other.request("read", station="left")["values"]["load"] for _ in range(1)]
        assert 0 <= loads[0] <= 100


def test_a_killed_engine_is_back_within_a_second_and_counts_on(appliance: Appliance) -> None:
    before = status()
    engine = before["processes"]["engine"]
    services = before["processes"]["services"]["pid"]
    stale = discarded().get("stale", 0)
    busy = slowness()
    os.kill(engine["pid"], signal.SIGSTOP)  # what comes now waits in its socket
    send(FOREIGN_PD, 3)
    count = received()
    os.kill(engine["pid"], signal.SIGKILL)
    took_s = wait_until(lambda: received() > count + 5)
    assert took_s < 1.0 * max(busy, slowness())
    after = status()
    assert after["processes"]["engine"]["restarts"] == engine["restarts"] + 1
    assert after["processes"]["engine"]["pid"] != engine["pid"]
    assert after["processes"]["services"]["pid"] == services
    rx = station(after, "right")["pd"]["rx"][0]
    elapsed = station(after, "right")["cycle"]
    assert rx["lost"] > 0
    assert abs(rx["received"] + rx["lost"] - elapsed) <= 3  # a gap of its true length
    assert discarded()["stale"] >= stale + 3
    assert_sorted_by_the_kernel()


def test_killed_services_do_not_disturb_publishing(appliance: Appliance) -> None:
    before = status()
    counted = discarded()
    services = before["processes"]["services"]
    send(MAILBOX, 2)
    wait_until(lambda: discarded().get("mailbox", 0) == counted.get("mailbox", 0) + 2)
    rx = station(status(), "right")["pd"]["rx"][0]
    os.kill(services["pid"], signal.SIGSTOP)
    send(MAILBOX, 4)
    os.kill(services["pid"], signal.SIGKILL)
    after = status()  # the client waits in the backlog of the listener
    assert after["processes"]["services"]["pid"] != services["pid"]
    wait_until(lambda: discarded().get("stale", 0) == counted.get("stale", 0) + 4)
    assert discarded()["mailbox"] == counted.get("mailbox", 0) + 2
    after = status()
    assert after["processes"]["services"]["restarts"] == services["restarts"] + 1
    assert after["processes"]["engine"]["pid"] == before["processes"]["engine"]["pid"]
    now = station(after, "right")["pd"]["rx"][0]
    assert (now["lost"], now["timeouts"]) == (rx["lost"], rx["timeouts"])
    assert_sorted_by_the_kernel()


def test_a_killed_supervisor_takes_all_along_and_the_next_start_succeeds(
    appliance: Appliance, shared: SharedAppliance
) -> None:
    pids = [process["pid"] for process in status()["processes"].values()]
    appliance.process.kill()
    appliance.process.wait()
    wait_until(lambda: not any(map(is_running, pids)), timeout_s=1.0 * slowness())
    again = shared.running()
    assert received() >= 0
    assert again.stop()[0] == 0


def test_interrupt_ends_the_command(appliance: Appliance) -> None:
    appliance.process.send_signal(signal.SIGINT)
    assert appliance.finish(timeout_s=2 * slowness())[0] == 0


def test_a_second_start_is_refused_by_name(appliance: Appliance, module_farm: Plants) -> None:
    code, out, err = start(module_farm).finish()
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert str(appliance.process.pid) in err
    assert status()["processes"]["supervisor"]["pid"] == appliance.process.pid


def test_stations_of_one_plant_run_in_two_appliances(alone: Plants) -> None:
    left, right = start(alone, "--station", "left"), start(alone, "--station", "right")
    assert left.wait_ready() == ["left"]
    assert right.wait_ready() == ["right"]
    clients = connect(plant="processes")
    assert sorted(client.info.stations[0] for client in clients) == ["left", "right"]
    for client in clients:
        client.close()
    (client,) = connect(station="right")
    with client:
        wait_until(lambda: client.request("status")["stations"][0]["pd"]["rx"][0]["received"] > 10)
    overlap = start(alone)  # of another name, but with the same addresses
    code, out, err = overlap.finish()
    assert (code, out, err.splitlines()[1:]) == (2, "", [])
    assert "127.9.3.1" in err
    assert left.stop()[0] == 0
    assert right.stop()[0] == 0


@pytest.mark.parametrize("kind", [socket.SOCK_DGRAM, socket.SOCK_STREAM])
def test_a_port_in_use_is_refused_in_one_line_and_nothing_stays(alone: Plants, kind: int) -> None:
    with socket.socket(socket.AF_INET, kind) as squatter:
        squatter.bind(("127.9.3.2", EAP_PORT))
        if kind == socket.SOCK_STREAM:
            squatter.listen()
        refused = start(alone)
        code, out, err = refused.finish()
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert "127.9.3.2:34980" in err
    assert list(refused.runtime.iterdir()) == []


def test_stop_by_the_control_protocol(appliance: Appliance) -> None:
    (client,) = connect()
    with client:
        assert client.request("stop") == {"stopping": True}
    assert appliance.finish(timeout_s=2 * slowness())[0] == 0


def read_to_end(connection: socket.socket) -> bytes:
    connection.settimeout(5)
    try:
        return connection.recv(16)
    except ConnectionResetError:
        return b""


def test_tcp_connections_go_where_their_first_frame_belongs(appliance: Appliance) -> None:
    before = Counter(discarded()), Counter(discarded("right"))

    def counted(name: str = "left") -> Counter[str]:
        return Counter(discarded(name)) - before[name == "right"]

    with socket.create_connection(LEFT) as connection:
        connection.sendall(MAILBOX)  # for nobody, so far
        connection.shutdown(socket.SHUT_WR)
        assert read_to_end(connection) == b""
    assert counted()["mailbox"] == 1
    with socket.create_connection(("127.9.1.2", EAP_PORT)) as connection:
        connection.sendall(FOREIGN_PD)
        assert read_to_end(connection) == b""
    assert counted("right") == {"tcp_off": 1}
    with socket.create_connection(LEFT) as connection:
        connection.sendall(FOREIGN_PD[:1])
        time.sleep(0.1)  # so that the first octet comes alone
        connection.sendall(FOREIGN_PD[1:] + FOREIGN_PD)
        wait_until(lambda: counted()["wrong_publisher"] + counted()["unknown_id"] == 2)
        connection.sendall(MAILBOX)
        assert read_to_end(connection) == b""
    wait_until(lambda: counted()["tcp_type"] == 1)


def test_a_wrong_plant_starts_nothing(alone: Plants) -> None:
    plant = alone.write(PLANT.replace("TCP", "perhaps"))
    refused = start(alone)
    code, out, err = refused.finish()
    assert (code, out) == (2, "")
    assert f"{plant}:7" in err
    assert not refused.runtime.exists()


def test_client_of_a_dead_appliance_gets_an_error(appliance: Appliance) -> None:
    (client,) = connect()
    appliance.process.kill()
    appliance.process.wait()
    with client, pytest.raises(ControlError, match="does not answer"):
        ask_for(client, seconds=10)


def ask_for(client: ControlClient, *, seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        client.request("hello")
