"""Readiness and watchdog, at a socket in place of a service manager."""

from __future__ import annotations

import os
import socket
from contextlib import contextmanager

import pytest

from eap.pd.layout import WORDS_OFFSET
from eap.supervisor.service_manager import CycleProgress, ServiceManager

SECOND = 1_000_000_000


@contextmanager
def listener(address):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as opened:
        opened.bind(address)
        opened.setblocking(False)
        yield opened


def received(opened):
    found = []
    try:
        while True:
            found.append(opened.recv(4096).decode())
    except BlockingIOError:
        return found


@pytest.mark.net
@pytest.mark.parametrize("abstract", [False, True])
def test_service_manager_gets_readiness_and_end(tmp_path, abstract):
    name = f"@eap-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with listener(name.replace("@", "\0")) as opened:
        environment = {"NOTIFY_SOCKET": name, "HOME": "/"}
        with ServiceManager(environment) as manager:
            assert environment == {"HOME": "/"}
            assert manager.next_ns is None
            manager.notify(READY="1", STATUS="plant x")
        assert received(opened) == ["READY=1\nSTATUS=plant x", "STOPPING=1"]


@pytest.mark.net
def test_watchdog_is_served_thrice_in_its_time_while_all_live(tmp_path, caplog):
    environment = {
        "NOTIFY_SOCKET": str(tmp_path / "notify"),
        "WATCHDOG_USEC": "30000000",
        "WATCHDOG_PID": str(os.getpid()),
    }
    with listener(environment["NOTIFY_SOCKET"]) as opened, ServiceManager(environment) as manager:
        assert environment == {}
        manager.check(5 * SECOND, is_alive=True)
        assert manager.next_ns == 15 * SECOND
        assert received(opened) == ["WATCHDOG=1"]
        for _ in range(2):
            manager.check(15 * SECOND, is_alive=False)
        assert (received(opened), manager.next_ns) == ([], 25 * SECOND)
        assert len(caplog.records) == 1
        manager.check(25 * SECOND, is_alive=True)
        assert received(opened) == ["WATCHDOG=1"]


@pytest.mark.net
@pytest.mark.parametrize(
    ("path", "limit", "owner"),
    [("", "1000", ""), ("relative", "1000", ""), ("/none", "1000", "1"), ("/none", "much", "")],
)
def test_other_environments_have_no_watchdog(path, limit, owner):
    environment = {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": limit, "WATCHDOG_PID": owner}
    with ServiceManager(environment) as manager:
        manager.notify(READY="1")  # nobody listens: no error
        assert manager.next_ns is None


def test_progress_ends_with_the_cycles(tmp_path):
    image = tmp_path / "left.image"
    progress = CycleProgress(image, cycle_us=1_000_000)
    assert progress.is_alive(0), "the engine has not made its image yet"

    def count(cycle):
        image.write_bytes(bytes(WORDS_OFFSET) + cycle.to_bytes(8, "little"))

    count(7)
    assert progress.is_alive(10 * SECOND)
    assert progress.is_alive(13 * SECOND), "three cycles may pass: the counter is read in between"
    assert not progress.is_alive(13 * SECOND + 1)
    count(8)
    assert progress.is_alive(20 * SECOND)
    image.unlink()
    assert progress.is_alive(30 * SECOND)
    assert not progress.is_alive(40 * SECOND)
