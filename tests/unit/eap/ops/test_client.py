"""The command line's side of the control protocol, against a scripted appliance."""

from __future__ import annotations

import json
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from devicebus.errors import AlStatusError
from eap.errors import ControlError
from eap.ops.client import (
    ControlClient,
    call_each,
    connect,
    request_each,
)
from eap.runtime.folder import ApplianceFolder, ApplianceInfo, ProcessInfo

pytestmark = pytest.mark.net


def info(plant: str = "demo", stations: tuple[str, ...] = ("a", "b")) -> ApplianceInfo:
    return ApplianceInfo(plant, "p.yaml", list(stations), "2026-01-01T00:00:00+00:00", os.getpid())


class Script:
    """Answers each request with the next lines, then hangs up."""

    def __init__(self, *answers: list[dict]) -> None:
        ours, theirs = socket.socketpair()
        self.client = ControlClient(ours, info())
        self.requests: list[dict] = []
        self._thread = threading.Thread(target=self._play, args=(theirs, answers))
        self._thread.start()

    def _play(self, connection, answers):
        with connection, connection.makefile("rb") as lines:
            for answer in answers:
                self.requests.append(json.loads(lines.readline()))
                for message in answer:
                    connection.sendall(json.dumps(message).encode() + b"\n")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.client.close()
        self._thread.join()


def test_a_request_and_its_result():
    with Script([{"v": 1, "id": 1, "result": {"written": 1}}]) as script:
        assert script.client.request("write", station="a", values={"x": 1}) == {"written": 1}
    assert script.requests == [
        {"v": 1, "id": 1, "method": "write", "params": {"station": "a", "values": {"x": 1}}}
    ]


def test_an_error_of_a_bus_is_what_it_was():
    error = {"code": "bus", "message": "refuses OP", "kind": "AlStatusError", "detail": 0x4001B}
    with (
        Script([{"v": 1, "id": 1, "error": error}]) as script,
        pytest.raises(AlStatusError, match="refuses OP") as caught,
    ):
        script.client.request_within(20, "bus_bring", state="OP")
    assert (caught.value.code, caught.value.state) == (0x1B, 4)


def test_a_refusal_keeps_its_code():
    error = {"code": "refused", "message": "held by process 7"}
    with (
        Script([{"v": 1, "id": 1, "error": error}]) as script,
        pytest.raises(ControlError, match="process 7") as caught,
    ):
        script.client.request("write")
    assert caught.value.code == "refused"


def test_events_follow_until_one_is_an_error():
    def event(cycle):
        return {"station": "a", "cycle": cycle, "values": {}, "quality": {}}

    lines = [
        {"v": 1, "id": 1, "result": {"subscription": 1}},
        {"v": 1, "subscription": 1, "event": event(1)},
        {"v": 1, "subscription": 1, "event": event(2)},
        {"v": 1, "subscription": 1, "event": {"error": {"code": "unavailable", "message": "t"}}},
    ]
    with Script(lines) as script:
        events = script.client.events(station="a")
        assert [next(events).cycle, next(events).cycle] == [1, 2]
        with pytest.raises(ControlError) as caught:
            next(events)
        assert caught.value.code == "unavailable"


def test_client_names_an_appliance_that_ends():
    with Script() as script, pytest.raises(ControlError, match=r"demo .* does not answer"):
        script.client.request("hello")


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path))


def listen(folder: ApplianceFolder) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(folder.control_socket))
    listener.listen()
    return listener


@pytest.mark.usefixtures("root")
def test_running_appliances_are_chosen_by_plant_and_station(tmp_path):
    with pytest.raises(ControlError, match="eapctl run PLANT") as caught:
        connect()
    assert str(tmp_path) in str(caught.value)
    with (
        ApplianceFolder.claim("demo") as demo,
        ApplianceFolder.claim("line") as line,
        ApplianceFolder.claim("starting"),
        listen(demo),
        listen(line),
    ):
        demo.write_info(info())
        line.write_info(info("line", ("c",)))

        def plants(**choice) -> list[str]:
            clients = connect(**choice)
            for client in clients:
                client.close()
            return [client.info.plant for client in clients]

        assert plants() == ["demo", "line"]
        assert plants(plant="line") == ["line"]
        assert plants(station="b") == ["demo"]
        with pytest.raises(ControlError, match=r"no station x runs.*demo \(a, b\), line \(c\)"):
            connect(station="x")


@pytest.mark.usefixtures("root")
def test_client_without_an_answer_names_the_processes_that_are_starting():
    with ApplianceFolder.claim("demo") as demo, listen(demo) as listener:
        starting = info()
        starting.engine = ProcessInfo(7, step="building station a")
        starting.services = ProcessInfo(0, 1)
        demo.write_info(starting)
        (client,) = connect()
        listener.accept()[0].close()
        with client, pytest.raises(ControlError) as caught:
            client.request("hello")
    assert "; engine is starting (building station a); services ended" in str(caught.value)


@pytest.mark.usefixtures("root")
def test_a_socket_that_does_not_listen_is_named():
    with ApplianceFolder.claim("demo") as demo:
        demo.write_info(info())
        with pytest.raises(ControlError, match="cannot be reached"):
            connect()


def answer_one(listener: socket.socket, result: object) -> None:
    """Answer the first request of the next client."""
    connection, _ = listener.accept()
    with connection, connection.makefile("rb") as lines:
        asked = json.loads(lines.readline())
        connection.sendall(json.dumps({"v": 1, "id": asked["id"], "result": result}).encode())
        connection.sendall(b"\n")


@pytest.fixture
def two_appliances(root: None) -> Iterator[tuple[socket.socket, socket.socket]]:
    """Listeners of two appliances that run parts of one plant."""
    with (
        ApplianceFolder.claim("demo@a") as one,
        ApplianceFolder.claim("demo@b+c") as other,
        listen(one) as first,
        listen(other) as second,
    ):
        one.write_info(info(stations=("a",)))
        other.write_info(info(stations=("b", "c")))
        yield first, second


def test_request_each_returns_the_answers_and_names_the_silent_appliances(
    two_appliances: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("eap.ops.client._PING_S", 0.1)
    monkeypatch.setattr("eap.ops.client.STATUS_S", 0.3)
    for answering, silent in (0, ["b", "c"]), (1, ["a"]):
        thread = threading.Thread(target=answer_one, args=(two_appliances[answering], 7))
        thread.start()
        with ExitStack() as stack:
            clients = [stack.enter_context(each) for each in connect()]
            answers, others = request_each(clients, "status")
            assert (answers, [each.stations for each in others]) == ([7], [silent])
        thread.join()
        two_appliances[1 - answering].accept()[0].close()


@pytest.mark.usefixtures("root")
def test_request_each_to_the_only_appliance_names_its_hung_services(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("eap.ops.client._PING_S", 0.05)
    with ApplianceFolder.claim("demo") as demo, listen(demo):
        running = info()
        running.engine, running.services = ProcessInfo(6), ProcessInfo(7)
        demo.write_info(running)
        (client,) = connect()
        with client, pytest.raises(ControlError, match="services hangs; look at process 7, or"):
            request_each([client], "status")


def test_request_each_waits_longer_while_no_appliance_answers(
    two_appliances: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("eap.ops.client._PING_S", 0.01)
    monkeypatch.setattr("eap.ops.client.TIMEOUT_S", 0.05)
    with ExitStack() as stack:
        clients = [stack.enter_context(each) for each in connect()]
        with pytest.raises(
            ControlError, match=r"appliance demo \(a; process \d+\) does not answer"
        ):
            request_each(clients, "status")


@pytest.mark.usefixtures("root")
def test_request_to_hung_services_ends_after_a_ping(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("eap.ops.client._PING_S", 0.05)
    with ApplianceFolder.claim("demo") as demo, listen(demo) as listener:
        running = info()
        running.engine = running.services = ProcessInfo(7)
        demo.write_info(running)
        (client,) = connect()
        with (
            client,
            pytest.raises(
                ControlError,
                match=r"demo \(a, b; process \d+\) does not answer: services hangs; look .* 7, or",
            ),
        ):
            client.request("status")  # no accept: the connections wait at the listener
        (client,) = connect()
        for _ in range(2):
            listener.accept()[0].close()

        def answer_both() -> None:
            slow = listener.accept()[0]
            answer_one(listener, {})  # the ping
            with slow, slow.makefile("rb") as lines:
                lines.readline()
                slow.sendall(b'{"v": 1, "id": 1, "result": 5}\n')

        thread = threading.Thread(target=answer_both)
        thread.start()
        with client:
            assert client.request("status") == 5
        thread.join()


def test_call_each_returns_the_answers_and_the_errors_of_silent_appliances() -> None:
    def call(number: int) -> int:
        if number < 0:
            raise ControlError(f"{number} does not answer", code="unavailable")
        if number == 0:
            raise ControlError("no such name", code="unknown_name")
        return number

    found, silent = call_each([-1, 2, -3, 4], call)
    assert (found, list(map(str, silent))) == ([2, 4], ["-1 does not answer", "-3 does not answer"])
    with pytest.raises(ControlError, match="-1 does not answer"):
        call_each([-1], call)
    with pytest.raises(ControlError, match="no such name"):
        call_each([1, 0], call)
