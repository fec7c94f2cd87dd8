"""Hostile hosts: three of them, with every bad kind of connection to every listener at once.

Clients of every kind read once a second meanwhile, and nothing of theirs fails.  ``EAP_LONG=1`` is
the campaign: 200 connections (``EAP_HOSTILE``) of each kind to each listener, 10 clients of each
kind and 10 receivers of process data, for 600 s (``EAP_SECONDS``).  ``EAP_LOAD=15`` runs that many
busy loops beside it.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from eap.errors import ControlError
from eap.gateway.client import GatewayClient
from eap.od.abort import AbortCode, SdoAbortError
from eap.ops.client import connect_those
from eap.runtime.folder import VARIABLE
from tests.support import aoe
from tests.support.amsclient import AmsClient
from tests.support.appliance import Appliance, Plants, run_eapctl, wait_until
from tests.support.gatewayplant import BUS, DRIVE
from tests.support.machine import slowness
from tests.support.namespaces import Namespace, enter, namespace

pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = [pytest.mark.net, pytest.mark.root]

IS_LONG = bool(os.environ.get("EAP_LONG"))
SECONDS = float(os.environ.get("EAP_SECONDS", "600")) if IS_LONG else 3.0
HOSTILE = int(os.environ.get("EAP_HOSTILE", "200")) if IS_LONG else 30
"""Connections of each kind to each listener, of all three hosts."""
CLIENTS = 10 if IS_LONG else 2
"""Of each kind."""
LOAD = int(os.environ.get("EAP_LOAD", "0"))
ADDRESS, FAR = "10.77.0.1", "10.77.0.5"
TARGET = f"{ADDRESS}.2.1"
GATEWAY_PORT = 34990
LATEST_S = 10.0
"""An answer that takes longer is a failure; a client usually gives up after 5 s or more."""
PDS = [
    (f"by-{frame}-{number}", frame) for frame in ("tcp", "udp") for number in range(CLIENTS // 2)
]
_SUBSCRIBE = "\n".join(
    f"      - {{name: {name}, port: eap0, from: far/{name}, timeout_ms: 5000}}" for name, _ in PDS
)
_PUBLISH = "\n".join(
    f"      - {{name: {name}, frame: {frame}, id: {number}, cycle_us: 100000, variables: [ticks]}}"
    for number, (name, frame) in enumerate(PDS, 1)
)
PLANT = f"""\
plant: loaded
defaults: {{cycle_us: 10000}}
stations:
  - name: mill
    net_id: {ADDRESS}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{ADDRESS}", net_id: {TARGET}, tcp: true}}
      - {{name: bus0, kind: bus, interface: "sim://gateway.yaml", net_id: {ADDRESS}.3.1}}
      - name: bus1
        kind: bus
        interface: "sim://gateway.yaml"
        net_id: {ADDRESS}.4.1
        gateway: {{port: {GATEWAY_PORT}}}
    subscribe:
@SUBSCRIBE@
  - name: far
    net_id: {FAR}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{FAR}", net_id: {FAR}.2.1}}
    variables: {{ticks: UDINT}}
    sources:
      ticks: {{kind: counter}}
    frames:
      - {{name: tcp, port: eap0, to: "tcp://{ADDRESS}"}}
      - {{name: udp, port: eap0, to: "{ADDRESS}"}}
    publish:
@PUBLISH@
""".replace("@SUBSCRIBE@", _SUBSCRIBE).replace("@PUBLISH@", _PUBLISH)


@contextmanager
def network() -> Iterator[list[Namespace]]:
    """Make the plant's host, with a bridge at 10.77.0.1, and four hosts 10.77.0.2 to 10.77.0.5."""
    with ExitStack() as stack:
        here, *hosts = [stack.enter_context(namespace()) for _ in range(5)]
        here.ip("link", "add", "br0", "type", "bridge")
        here.ip("addr", "add", f"{ADDRESS}/24", "dev", "br0")
        here.ip("link", "set", "br0", "up")
        for number, host in enumerate(hosts, 2):
            port = f"port{number}"
            here.ip(
                "link", "add", port, "type", "veth", "peer", "name", "line0", "netns", host.name
            )
            here.ip("link", "set", port, "master", "br0", "up")
            host.ip("addr", "add", f"10.77.0.{number}/24", "dev", "line0")
            host.plug()
        yield [here, *hosts]


@contextmanager
def programs(*commands: list[str]) -> Iterator[None]:
    """Run programs until the end of the block; none may end before."""
    with ExitStack() as stack:
        running = []
        for command in commands:
            running.append(process := subprocess.Popen(command))
            stack.callback(process.wait)
            stack.callback(process.kill)
        yield
        assert [each.poll() for each in running] == [None] * len(running)


def attackers(here: Namespace, hosts: list[Namespace], control: Path) -> list[list[str]]:
    """Return the commands of three hostile hosts, and of one more program on the plant's own."""
    task = {
        "address": ADDRESS, "ams": [48898], "frames": [34980, GATEWAY_PORT], "control": [],
        "count": HOSTILE // 3, "pause_s": 20.0 if IS_LONG else 2.0,
    }  # fmt: skip
    own = task | {"ams": [], "frames": [], "control": [str(control)], "count": HOSTILE}
    start = [sys.executable, "-m", "tests.support.hostile"]
    found = [[*host.prefix, *start, json.dumps(task)] for host in hosts]
    return [*found, [*here.prefix, *start, json.dumps(own)]]


Client = tuple[Callable[[], object], Callable[[], None]]
"""A call that reads once, and one that closes the connection."""


class Reader(threading.Thread):
    """A client in a namespace that reads once a second, in a thread of its own.

    Args:
        kind: Of client.
        host: Where it is.
        connect: Returns a call that reads once, and one that closes the connection.
        is_fleeting: Whether it connects anew for each read.
    """

    def __init__(
        self,
        kind: str,
        host: Namespace,
        connect: Callable[[], Client],
        *,
        is_fleeting: bool,
    ) -> None:
        super().__init__(daemon=True)
        self.kind = kind
        self.failures: list[str] = []
        self.took_s: list[float] = []
        self._host = host
        self._connect = connect
        self._is_fleeting = is_fleeting
        self._end = threading.Event()

    def stop(self) -> None:
        self._end.set()

    def run(self) -> None:
        enter(self._host)
        client = None
        while not self._end.is_set():
            start = time.monotonic()
            try:
                client = client or self._connect()
                client[0]()
            except Exception as exc:  # noqa: BLE001  told at the end
                self.failures.append(f"{self.kind} {self._host.name}: {exc!r}")
                client = self._closed(client)
            took_s = time.monotonic() - start
            self.took_s.append(took_s)
            if took_s > LATEST_S:
                self.failures.append(f"{self.kind}: took {took_s:.1f} s")
            if self._is_fleeting:
                client = self._closed(client)
            self._end.wait(max(0.0, 1 - took_s))
        self._closed(client)

    @staticmethod
    def _closed(client: Client | None) -> None:
        if client is not None:
            client[1]()


def by_ams() -> Client:
    client = AmsClient(ADDRESS)
    client.socket.settimeout(LATEST_S)

    def read() -> None:
        assert client.net_id(TARGET) == TARGET

    return read, client.socket.close


PYADS_PROGRAM = f"""
import ctypes, sys
import pyads
connection = pyads.Connection("{TARGET}", 0xFFFF, "{ADDRESS}")
for line in sys.stdin:
    try:
        connection.open()
        connection.read(0xF302, 0xF9200001, ctypes.c_uint8 * 6)
        if line == "close\\n":
            connection.close()
    except Exception as exc:
        connection.close()
        print(repr(exc), flush=True)
    else:
        print("ok", flush=True)
"""
"""Reads at each line of its input; AdsLib has one connection for all of a process."""


def by_pyads(started: ExitStack, *, is_fleeting: bool) -> Client:
    """Start a process of pyads in the namespace of this thread; it lives until the end."""
    command = [sys.executable, "-c", PYADS_PROGRAM]
    pipe = subprocess.PIPE
    process = started.enter_context(subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True))
    started.callback(process.kill)
    assert process.stdin
    assert process.stdout
    requests, answers = process.stdin, process.stdout

    def read() -> None:
        requests.write("close\n" if is_fleeting else "read\n")
        requests.flush()
        answer = answers.readline()
        assert answer == "ok\n", answer

    return read, lambda: None


def by_frames(kind: socket.SocketKind) -> Client:
    """Ask by type 5; a datagram that is lost is sent again, as clients do."""
    sock = socket.socket(socket.AF_INET, kind)
    is_stream = kind == socket.SOCK_STREAM
    sock.settimeout(LATEST_S if is_stream else LATEST_S / 5)
    sock.connect((ADDRESS, 34980))
    request = aoe.frame(aoe.packet(TARGET, aoe.READ_STATE, b""))

    def read() -> None:
        for _ in range(1 if is_stream else 4):
            sock.send(request)
            try:
                answer = sock.recv(2048)
            except TimeoutError:
                continue
            assert aoe.answer(answer).error == 0
            return
        raise TimeoutError

    return read, sock.close


def by_gateway(port: int, *, tcp: bool) -> Client:
    client = GatewayClient(ADDRESS, port, tcp=tcp, timeout_s=2.0, tries=4)

    def read() -> None:
        """Read of a slave, which all these clients share; one told that it is busy asks again."""
        end_s = time.monotonic() + LATEST_S
        while True:
            try:
                client.sdo_read(DRIVE, 0x1018, 1)
            except SdoAbortError as exc:
                if exc.code != AbortCode.LOCAL_CONTROL or time.monotonic() > end_s:
                    raise
            else:
                return

    return read, client.close


def by_control(runtime: Path) -> Client:
    (client,) = connect_those(lambda info: info.plant == "loaded" and "mill" in info.stations)
    return lambda: client.request_within(LATEST_S, "read", station="mill"), client.close


def by_command(runtime: Path) -> Client:
    def read() -> None:
        done = run_eapctl(runtime, "status", "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["stations"]

    return read, lambda: None


def clients(here: Namespace, friend: Namespace, runtime: Path, started: ExitStack) -> list[Reader]:
    """Return all clients: half of them on the plant's host, half of them keep their connection."""
    kinds: dict[str, Callable[[], Client]] = {
        "ams": by_ams,
        "type 5 TCP": lambda: by_frames(socket.SOCK_STREAM),
        "type 5 UDP": lambda: by_frames(socket.SOCK_DGRAM),
        "gateway TCP": lambda: by_gateway(34980, tcp=True),
        "gateway UDP": lambda: by_gateway(34980, tcp=False),
        "gateway TCP+n": lambda: by_gateway(GATEWAY_PORT, tcp=True),
        "control": lambda: by_control(runtime),
    }
    found = []
    for kind, connect in kinds.items():
        for number in range(CLIENTS):
            host = here if number % 2 or kind == "control" else friend
            is_fleeting = number % 4 > 1
            found.append(Reader(kind, host, connect, is_fleeting=is_fleeting))
    for number in range(CLIENTS):
        connect = partial(by_pyads, started, is_fleeting=number % 4 > 1)
        found.append(Reader("pyads", (here, friend)[number % 2], connect, is_fleeting=False))
    if IS_LONG:
        found.append(Reader("eapctl", here, lambda: by_command(runtime), is_fleeting=False))
    return found


def patient_status(appliance: Appliance) -> dict[str, Any]:
    """Return the status, even if it takes longer than a client waits: readers judge that."""
    for _ in range(20):
        with suppress(ControlError):
            return appliance.status()
    return appliance.status()


def figures(appliance: Appliance) -> dict[str, Any]:
    """Return what must not grow, and what must not change."""
    status = patient_status(appliance)
    processes = status["processes"]
    flat = {name: processes[name] for name in ("supervisor", "engine", "services")}
    rx = {row["name"]: row for row in status["stations"][0]["pd"]["rx"]}
    return {
        "processes": {name: (each["pid"], each.get("restarts", 0)) for name, each in flat.items()},
        "rss": {name: each["rss"] for name, each in flat.items()},
        "descriptors": {name: each["descriptors"]["used"] for name, each in flat.items()},
        "state": status["stations"][0]["state"],
        "slaves": {
            slave["state"]
            for port in status["stations"][0]["ports"]
            for slave in port.get("bus", {}).get("slaves", ())
        },
        "received": {name: row["received"] for name, row in rx.items()},
        "timeouts": {name: row["timeouts"] for name, row in rx.items()},
        "listeners": {
            row["name"]: {key: row[key] for key in ("open", "refused", "evicted", "overdue")}
            for row in status["listeners"]
        },
        "discarded": status["stations"][0]["discarded"],
    }


def test_clients_are_served_while_three_hosts_attack_every_listener(
    farm: Plants, monkeypatch: pytest.MonkeyPatch
) -> None:
    with network() as (here, *hosts, friend), ExitStack() as stack:
        farm.write(BUS, "gateway.yaml")
        plant = farm.write(PLANT)
        appliance = farm.run(plant, "--station", "mill", prefix=here.prefix)
        farm.run(plant, "--station", "far", prefix=friend.prefix)
        monkeypatch.setenv(VARIABLE, str(appliance.runtime))
        wait_until(lambda: figures(appliance)["slaves"] == {"OP"})
        wait_until(lambda: all(figures(appliance)["received"].values()))
        before = figures(appliance)
        (control,) = appliance.runtime.glob("*/control*")
        busy = [[sys.executable, "-c", "while True: pass"]] * LOAD
        stack.enter_context(programs(*busy, *attackers(here, hosts, control)))
        wait_until(lambda: all(_is_crowded(row) for row in _rows(appliance)), 60)
        readers = clients(here, friend, appliance.runtime, stack)
        for each in readers:
            each.start()
        middle = _watch(appliance, SECONDS)
        findings = _findings(appliance)
        for each in readers:
            each.stop()
        for each in readers:
            each.join(2 * LATEST_S)
        stack.close()
        during = figures(appliance)
        _report(readers, before, middle, during)
        # Nothing is broken: an error would name a wrong cause.
        assert [each for each in findings if each["severity"] == "error"] == []
        failures = [failure for each in readers for failure in each.failures]
        if LOAD or slowness() > 2:  # a busy machine may be late, and must say so
            late = [each for each in failures if "timed out" in each or "no answer from" in each]
            # A short run has few reads.
            assert len(late) < sum(len(each.took_s) for each in readers) / (200 if LOAD else 2)
            failures = [failure for failure in failures if failure not in late]
        assert failures == []
        assert min(len(each.took_s) for each in readers) > SECONDS / (4 if LOAD else 2) - 2
        assert during["processes"] == before["processes"]
        assert (during["state"], during["slaves"]) == (before["state"], before["slaves"])
        assert during["timeouts"] == before["timeouts"]
        for name, received in during["received"].items():
            assert received > before["received"][name] + 5 * SECONDS
        assert during["rss"]["services"] < middle["rss"]["services"] + (24 << 20)
        wait_until(
            lambda: (
                figures(appliance)["descriptors"]["services"]
                <= before["descriptors"]["services"] + 4
            ),
            60,
        )
        assert during["descriptors"]["engine"] < before["descriptors"]["engine"] + 40


def _rows(appliance: Appliance) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = patient_status(appliance)["listeners"]
    return rows


def _is_crowded(row: dict[str, Any]) -> bool:
    return bool(row["open"] > (HOSTILE // 3 if row["name"] != "control" else 20))


def _findings(appliance: Appliance) -> list[dict[str, Any]]:
    """Return what ``eapctl status`` tells an operator while the attack goes on."""
    for _ in range(20):
        done = run_eapctl(appliance.runtime, "status", "--json")
        if done.returncode == 0:
            break
    found: list[dict[str, Any]] = json.loads(done.stdout)["findings"]
    for each in found:
        print(json.dumps(each))
    return found


def _watch(appliance: Appliance, seconds: float) -> dict[str, Any]:
    """Wait; return the figures of a third of the way."""
    time.sleep(seconds / 3)
    middle = figures(appliance)
    time.sleep(seconds * 2 / 3)
    return middle


def _report(readers: list[Reader], *moments: dict[str, Any]) -> None:
    """Print what a campaign is run for; pytest shows it with ``-s`` or on a failure."""
    by_kind: dict[str, list[float]] = {}
    failed: Counter[str] = Counter()
    for each in readers:
        by_kind.setdefault(each.kind, []).extend(each.took_s)
        failed[each.kind] += len(each.failures)
    for kind, took_s in by_kind.items():
        ordered = sorted(took_s)
        print(
            f"{kind}: {len(ordered)} reads, {failed[kind]} failed; ms: p50"
            f" {ordered[len(ordered) // 2] * 1e3:.0f}, p99"
            f" {ordered[len(ordered) * 99 // 100] * 1e3:.0f}, max {ordered[-1] * 1e3:.0f}"
        )
    kinds = Counter(failure for each in readers for failure in each.failures)
    for failure, times in kinds.most_common(20):
        print(f"{times} times: {failure}")
    for name, moment in zip(("before", "a third", "end"), moments, strict=True):
        print(f"{name}: {json.dumps(moment, default=sorted)}")
