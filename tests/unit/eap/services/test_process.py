"""The services process on images and sockets of the test."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import msgspec
import pytest

from eap.codec.ethercat import EtherCatHeader
from eap.ids import InterfaceUri, NetId
from eap.net.image_file import create_image
from eap.ops.client import ControlClient
from eap.pd.layout import plan_layout
from eap.pd.spec import PortKind, PortSpec
from eap.runtime.engine_messages import BusReport, EngineReply, EngineRequest
from eap.runtime.folder import ApplianceFolder, ApplianceInfo
from eap.runtime.handover import Handover
from eap.runtime.startup import Report
from eap.services import tasks
from eap.supervisor.sockets import SharedSockets, inherited_by_services
from tests.support.startup import read_reports

pytestmark = pytest.mark.net

MODULE = "eap.services.process"


class Services:
    """Services as the supervisor starts it."""

    def __init__(self, tmp_path, stations, supervisor: int) -> None:
        self.folder = ApplianceFolder(tmp_path)
        self.info = ApplianceInfo(
            "demo", "demo.yaml", [s.name for s in stations], "2026-01-01T00:00:00+00:00", 1
        )
        self.folder.write_info(self.info)
        self.sockets = SharedSockets(self.folder.control_socket)
        self.ready, ready_end = os.pipe()
        handover = Handover(
            supervisor,
            str(tmp_path),
            "demo",
            "demo.yaml",
            stations,
            self.sockets.fit(stations),
            link_fd=self.sockets.services_link,
            control_fd=self.sockets.control,
            buses=self.sockets.fit_buses(stations),
            bus_fd=self.sockets.services_bus,
            supervisor_fd=self.sockets.services_end,
        )
        fd = handover.to_descriptor()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "eap.runtime.startup", MODULE, str(fd), str(ready_end), ""],
            pass_fds=(fd, ready_end, *inherited_by_services(handover)),
            stderr=subprocess.PIPE,
            text=True,
        )
        os.close(fd)
        os.close(ready_end)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.communicate()
        self.sockets.close()
        os.close(self.ready)

    def connect(self) -> ControlClient:
        connection = socket.socket(socket.AF_UNIX)
        connection.connect(str(self.folder.control_socket))
        return ControlClient(connection, self.info)


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_services_answers_counts_and_ends_on_request(tmp_path, stations, number):
    with Services(tmp_path, stations, os.getpid()) as services:
        with services.connect() as client:  # before it runs: the listener is the supervisor's
            assert client.request("hello")["stations"] == ["left", "right"]
            *steps, ready = read_reports(services.ready)
            assert Report("building station right") in steps
            assert ready == Report(ready={}, is_watched=True)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.sendto(EtherCatHeader(6, 0, 5).encode() + bytes(6), ("127.9.2.1", 34980))
            for _ in range(1000):
                left, right = client.request("status")["stations"]
                if left["discarded"]:
                    break
            assert left["discarded"] == {"mailbox": 1}
            assert right["discarded"] == {}
        services.process.send_signal(number)
        assert services.process.communicate(timeout=20)[1] == ""
        assert services.process.returncode == 0


def answer_one(fd: int, make) -> None:
    """Be the process at the other end of a pair for one request."""
    with socket.socket(fileno=os.dup(fd)) as pair:
        pair.setblocking(True)
        pair.send(make(pair.recv(1 << 16)))


def say_up(octets: bytes) -> bytes:
    request = msgspec.msgpack.decode(octets, type=EngineRequest)
    return msgspec.msgpack.encode(
        EngineReply(id=request.id, report=BusReport(is_up=True, cycles=7))
    )


def say_ok(octets: bytes) -> bytes:
    return msgspec.json.encode({"id": msgspec.json.decode(octets)["id"], "ok": True})


def test_services_reads_engine_and_segment(tmp_path, stations):
    port = PortSpec(
        "bus0", PortKind.BUS, InterfaceUri.parse("sim://x.yaml"), NetId.parse("1.2.3.4.6.1")
    )
    station = msgspec.structs.replace(stations[0], ports=(*stations[0].ports, port))
    where = {"station": "left", "port": "bus0"}
    with (
        create_image(tmp_path / "left.image", plan_layout(station)),
        Services(tmp_path, (station,), os.getpid()) as services,
        services.connect() as client,
        ThreadPoolExecutor(1) as other,
    ):
        silent = client.request("status")["stations"][0]["ports"][1]
        assert silent["link"] == "down"
        engine_fd = services.sockets.engine_bus
        with socket.socket(fileno=os.dup(engine_fd)) as pair:
            pair.recv(1 << 16)  # what status has asked for
            pair.recv(1 << 16)
        said = other.submit(answer_one, engine_fd, say_up)
        assert client.request("bus_describe", **where)["cycles"] == 7
        said.result(5)
        said = other.submit(answer_one, services.sockets.buses[0].segment_command_fd, say_ok)
        assert client.request("bus_fault", **where, command={"kind": "loss"}) == {"ok": True}
        said.result(5)
        services.process.terminate()
        assert services.process.communicate(timeout=20)[1] == ""
        assert services.process.returncode == 0


@pytest.mark.usefixtures("files")
def test_an_orphan_does_not_start(tmp_path, stations):
    with Services(tmp_path, stations, supervisor=1) as services:
        services.process.communicate(timeout=20)
        assert services.process.returncode == -signal.SIGKILL


def test_services_waits_for_images_as_long_as_the_supervisor_lets_it(tmp_path, stations):
    with Services(tmp_path, stations, os.getpid()) as services:
        with os.fdopen(os.dup(services.ready)) as reports:
            steps = (msgspec.json.decode(line, type=Report) for line in reports)
            waiting = next(each for each in steps if each.waits_for)
        assert waiting.waits_for == "engine"
        assert waiting.step.startswith("waiting for the engine: ")
        services.process.terminate()
        assert services.process.communicate(timeout=20)[1] == ""


def test_keep_serving_begins_again_after_an_error_of_a_socket(monkeypatch, caplog):
    monkeypatch.setattr(tasks, "_RETRY_S", 0.0)
    outcomes = [OSError(24, "Too many open files"), None]

    async def serve():
        outcome = outcomes.pop(0)
        if outcome is not None:
            raise outcome

    asyncio.run(tasks.keep_serving(serve))
    assert outcomes == []
    assert "Too many open files" in caplog.messages[0]
