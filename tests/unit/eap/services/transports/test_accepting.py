"""Accepted connections, their limits and names."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import threading
from contextlib import ExitStack

import pytest

from eap.net.limits import CloseReason, ListenerLimits
from eap.services.transports import accepting
from eap.services.transports.accepting import (
    Listeners,
    ListeningSocket,
    TaskConnection,
    connection_name,
)
from tests.support.appliance import wait_until
from tests.support.eventually import eventually

pytestmark = pytest.mark.net

LIMITS = ListenerLimits(total=2, reserved=0)


class Echo:
    """A server of connections that answers each byte, and keeps what happened."""

    def __init__(self) -> None:
        self.connections: list[TaskConnection] = []
        self.refused: list[str] = []
        self.failure: Exception | None = None

    def connection_from(self, sock, host):
        self.connections.append(TaskConnection(host))
        return self.connections[-1]

    async def serve_connection(self, connection, sock):
        connection.begin()
        loop = asyncio.get_running_loop()
        while data := await loop.sock_recv(sock, 1):
            connection.note_frame()
            if self.failure is not None:
                raise self.failure
            await loop.sock_sendall(sock, data)

    def refuse_connection(self, sock, why):
        self.refused.append(why)


def serve(script, *, limits=LIMITS, overdue_ns=10_000_000_000, family=socket.AF_INET, path=""):
    """Run ``script(connect, echo, listeners)`` while an Echo serves a listener."""
    echo, listeners = Echo(), Listeners(overdue_ns)

    async def run():
        with socket.socket(family) as listener, ExitStack() as stack:
            listener.bind(path or ("127.0.0.1", 0))
            listener.listen()

            def connect():
                sock = stack.enter_context(socket.socket(family))
                sock.connect(listener.getsockname())
                sock.settimeout(5)
                return sock

            transport = ListeningSocket(listener, "test", echo, listeners, limits)
            tasks = [asyncio.ensure_future(each.serve()) for each in (transport, listeners)]
            try:
                await asyncio.wait_for(asyncio.to_thread(script, connect, echo, listeners), 20)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.wait(tasks)

    asyncio.run(run())
    return echo


def is_served(sock):
    sock.sendall(b"x")
    return sock.recv(1) == b"x"


def test_listener_serves_as_many_as_it_has_places(monkeypatch):
    monkeypatch.setattr(accepting, "host_of", lambda peer, own: "10.0.0.1")

    def script(connect, echo, listeners):
        served = [connect() for _ in range(2)]
        assert all(map(is_served, served))
        assert connect().recv(1) == b""
        served[0].close()
        wait_until(lambda: listeners.stats()[0].open == 1)
        assert is_served(connect())

    assert serve(script).refused == ["all 2 places are taken"]


def test_program_of_this_host_takes_the_place_of_the_one_silent_longest():
    def script(connect, echo, listeners):
        first, second = connect(), connect()
        assert is_served(first)
        assert is_served(second)
        assert is_served(connect())
        assert first.recv(1) == b""
        assert is_served(second)

    assert serve(script).refused == []


def test_crowd_that_comes_at_once_is_counted_before_it_runs():
    def script(connect, echo, listeners):
        crowd = [connect() for _ in range(40)]
        wait_until(lambda: listeners.stats()[0].evicted == 38)
        assert [each.recv(1) for each in crowd[:38]] == [b""] * 38
        assert all(map(is_served, crowd[38:]))
        assert [each.closed_for for each in echo.connections[:38]] == [CloseReason.EVICTED] * 38

    serve(script)


def test_peer_that_leaves_a_frame_unfinished_is_closed(caplog):
    def script(connect, echo, listeners):
        slow, good = connect(), connect()
        assert is_served(slow)
        assert is_served(good)
        echo.connections[0].note_partial()
        assert slow.recv(1) == b""
        assert is_served(good)
        wait_until(lambda: caplog.messages)

    serve(script, overdue_ns=50_000_000)
    (message,) = caplog.messages
    assert message.startswith("test: too many or too slow connections: 1 of 2 open;")
    assert message.endswith("0 refused, 0 closed for new ones, 1 closed as too slow")


@pytest.mark.parametrize(("failure", "lines"), [(OSError(5, "x"), 0), (RuntimeError("a fault"), 1)])
def test_failure_of_a_connection_ends_that_one_only(failure, lines, caplog):
    def script(connect, echo, listeners):
        echo.failure, bad = failure, connect()
        bad.sendall(b"x")
        assert bad.recv(1) == b""
        echo.failure = None
        assert is_served(connect())

    serve(script)
    assert len(caplog.records) == lines


def test_listener_without_descriptors_closes_an_unused_connection(monkeypatch):
    errors = [OSError(errno.EMFILE, "Too many open files")]

    class Short(socket.socket):
        def accept(self):
            if errors and is_short.is_set():
                raise errors.pop()
            return super().accept()

    is_short = threading.Event()
    monkeypatch.setattr(socket, "socket", Short)

    def script(connect, echo, listeners):
        unused = connect()
        wait_until(lambda: listeners.stats()[0].open == 1)
        is_short.set()
        assert is_served(connect())
        assert unused.recv(1) == b""
        assert listeners.stats()[0].evicted == 1

    serve(script)


def test_few_descriptors_are_kept_for_the_control_socket(monkeypatch, tmp_path):
    monkeypatch.setattr(accepting, "spare_descriptors", lambda _, reserve: 1500 - reserve)
    monkeypatch.setattr(accepting, "descriptor_reserve", lambda: 2000)

    def refused(connect, echo, listeners):
        assert connect().recv(1) == b""

    def served(connect, echo, listeners):
        assert is_served(connect())
        assert echo.connections[0].host == f"process {os.getpid()}"

    assert "no file descriptors are left" in serve(refused).refused[0]
    path = str(tmp_path / "socket")
    assert serve(served, family=socket.AF_UNIX, path=path).refused == []


def test_connection_that_is_closed_before_it_begins_is_not_served():
    async def run():
        connection = TaskConnection("")
        connection.close(CloseReason.EVICTED)
        connection.begin()
        with pytest.raises(asyncio.CancelledError):
            await asyncio.Event().wait()

    asyncio.run(run())


def test_listener_accepts_again_after_an_error(monkeypatch):
    monkeypatch.setattr(accepting, "_PAUSE_S", 0.0)
    asked = []

    async def run():
        listeners = Listeners()
        with socket.create_server(("127.0.0.1", 0)) as listener:
            transport = ListeningSocket(listener, "test", Echo(), listeners, LIMITS)
            monkeypatch.setattr(accepting, "wait_readable", lambda _: asyncio.sleep(0))
            monkeypatch.setattr(transport, "_socket", Broken(asked))
            serving = asyncio.ensure_future(transport.serve())
            await eventually(lambda: len(asked) > 2)
            serving.cancel()
            await asyncio.wait([serving])

    asyncio.run(run())


class Broken:
    """A listener whose accept fails."""

    def __init__(self, asked):
        self._asked = asked

    def setblocking(self, flag):
        pass

    def accept(self):
        self._asked.append(1)
        raise OSError(errno.EINVAL, "Invalid argument")


def test_no_two_connections_have_the_same_name():
    listener = socket.create_server(("127.0.0.1", 0))
    with listener, socket.create_connection(listener.getsockname()) as one:
        here = "{}:{}#".format(*listener.getsockname())
        names = [connection_name(one) for _ in range(2)]
    assert len(set(names)) == 2
    assert all(name.startswith(here) for name in names)
    with socket.socket() as gone:
        assert connection_name(gone).startswith(":0#")
    pair = socket.socketpair()
    assert connection_name(pair[0]).startswith(":0#")
    for each in pair:
        each.close()
