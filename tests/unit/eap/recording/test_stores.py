"""Rows on their way to a store: breaks, limits, refusals; the line protocol of InfluxDB."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator, Sequence
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any, cast

import pytest

from eap.codec.datatypes import parse
from eap.errors import ConfigError, EnvironmentalError
from eap.recording import stores
from eap.recording.header import EventKind, RecordingEvent
from eap.recording.influx import InfluxStore
from eap.recording.messages import StationMessages, pack_closely
from eap.recording.rows import ValueColumn, source_of
from eap.recording.stores import (
    StoreError,
    StoreRow,
    StoreSequence,
    StoreTable,
    check_url,
    shown_url,
)
from tests.support.recordings import T0, VARIABLES, sample

TABLES = [StoreTable("s", (ValueColumn("s/v", "s/v", parse("UINT"), "UINT", ""),))]


class Memory:
    """A store that fails as often as a test wants."""

    def __init__(self) -> None:
        self.rows: list[StoreRow] = []
        self.events: list[RecordingEvent] = []
        self.failures: list[StoreError] = []
        self.closed = 0

    def open(self, plant: str, tables: Sequence[StoreTable]) -> None:
        self._fail()

    def write(self, rows: Sequence[StoreRow], events: Sequence[RecordingEvent]) -> None:
        self._fail()
        self.rows += rows
        self.events += events

    def close(self) -> None:
        self.closed += 1

    def _fail(self) -> None:
        if self.failures:
            raise self.failures.pop(0)


def opened(store: Memory, clock: list[float]) -> StoreSequence:
    sequence = StoreSequence(store, "postgresql://u:secret@h/d", lambda: clock[0])
    sequence.begin("p", TABLES)
    sequence._is_open = True
    return sequence


def row(number: int) -> StoreRow:
    return StoreRow(0, T0 + number, number, [number])


def test_rows_wait_for_a_store_that_does_not_answer() -> None:
    store, clock = Memory(), [100.0]
    sequence = opened(store, clock)
    store.failures = [StoreError("connection refused"), StoreError("connection refused")]
    for number in range(4):
        sequence.queue(row(number))
        sequence.flush()
    assert (sequence.messages, store.rows) == (0, [])
    assert sequence.trouble == "postgresql://u:***@h/d: connection refused"
    for _ in range(2):
        clock[0] += 1.0
        sequence.flush()
    assert [each.cycle for each in store.rows] == [0, 1, 2, 3]
    assert (sequence.messages, sequence.lost, sequence.trouble) == (4, 0, "")


def test_oldest_rows_are_lost_beyond_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "WAITING_BYTES", 10 * 96)
    store, clock = Memory(), [0.0]
    sequence = opened(store, clock)
    for number in range(25):
        sequence.queue(row(number))
    sequence.flush()
    assert [each.cycle for each in store.rows] == list(range(15, 25))
    assert (sequence.messages, sequence.lost) == (10, 15)


def test_rows_that_a_store_refuses_for_good_end_the_recording() -> None:
    store = Memory()
    sequence = opened(store, [0.0])
    store.failures = [StoreError("no such table", is_final=True)]
    sequence.queue(row(1))
    with pytest.raises(EnvironmentalError, match="no such table"):
        sequence.flush()


def test_end_waits_for_the_last_rows_no_longer_than_ten_seconds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    store, clock = Memory(), [0.0]
    sequence = opened(store, clock)

    def pause() -> None:
        clock[0] += 3.0

    monkeypatch.setattr(stores, "_pause", pause)
    store.failures = [StoreError("down")] * 2
    sequence.queue(row(1))
    sequence.close(0)
    assert (sequence.messages, sequence.lost) == (1, 0)
    store.failures = [StoreError("down")] * 99
    sequence.queue(row(2))
    sequence.close(0)
    assert (sequence.messages, sequence.lost) == (1, 1)
    assert clock[0] < 30


def test_events_are_stored_with_the_rows() -> None:
    store = Memory()
    sequence = opened(store, [0.0])
    event = RecordingEvent(time_ns=T0, kind=EventKind.MARK, text="door open")
    sequence.add_event(event)
    sequence.flush()
    assert store.events == [event]


@pytest.mark.parametrize("url", ["mysql://h/d", "postgresql:d", "h", "influx+ftp://h"])
def test_other_urls_are_refused(url: str) -> None:
    with pytest.raises(ConfigError, match="expected a store such as"):
        check_url(url)


def test_password_is_not_shown() -> None:
    assert shown_url("postgresql://u:p@h:1/d?x=y") == "postgresql://u:***@h:1/d?x=y"
    assert shown_url("influx+udp://h:1") == "influx+udp://h:1"


class Influx(HTTPServer):
    """A server that keeps what is posted."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.posts: list[tuple[str, str | None, bytes]] = []
        self.status = 204


class _Handler(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        server = cast("Influx", self.server)
        server.posts.append((self.path, self.headers.get("Authorization"), body))
        self.send_response(server.status)
        self.end_headers()

    def log_message(self, *args: Any) -> None:
        """Print nothing."""


@pytest.fixture
def influx() -> Iterator[Influx]:
    with Influx() as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.mark.net
def test_lines_have_the_form_of_the_protocol(
    influx: Influx, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("INFLUX_TOKEN", "t0k")
    store = InfluxStore(f"influx+http://127.0.0.1:{influx.server_port}/api/v2/write?bucket=b")
    messages = StationMessages("island 1", pack_closely(VARIABLES))
    tables = [StoreTable("island 1", source_of(messages).columns)]
    store.open("my,mill", tables)
    store.open("my,mill", tables)
    _, values = messages.unpack(messages.pack(3, sample(3)))
    event = RecordingEvent(time_ns=T0, kind=EventKind.MARK, text='say "x"')
    store.write([StoreRow(0, T0 + 3, 3, values)], [event])
    path, token, body = influx.posts[-1]
    assert len(influx.posts) == 2
    assert (path, token) == ("/api/v2/write?bucket=b&precision=ns", "Token t0k")
    fields = (
        "temp=1.0,count=3i,axis.position=-3i,axis.on=t,list[0]=3i,list[1]=-3i,"
        'mode="On",raw="030102",name="n3"'
    )
    assert body.decode().splitlines() == [
        f"island\\ 1,plant=my\\,mill {fields} {T0 + 3}",
        f'recording_events,plant=my\\,mill,kind=mark text="say \\"x\\"",count=0i {T0}',
    ]


@pytest.mark.net
@pytest.mark.parametrize(("status", "is_final"), [(401, True), (503, False), (429, False)])
def test_answer_tells_whether_another_attempt_helps(
    influx: Influx, status: int, is_final: bool
) -> None:
    influx.status = status
    store = InfluxStore(f"influx+http://127.0.0.1:{influx.server_port}")
    with pytest.raises(StoreError, match=f"HTTP {status}") as caught:
        store.open("p", TABLES)
    assert caught.value.is_final is is_final


@pytest.mark.net
@pytest.mark.parametrize(
    ("family", "host"), [(socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")]
)
def test_lines_go_by_udp(family: socket.AddressFamily, host: str) -> None:
    with socket.socket(family, socket.SOCK_DGRAM) as receiver:
        receiver.bind((host, 0))
        receiver.settimeout(20)
        shown = f"[{host}]" if ":" in host else host
        store = InfluxStore(f"influx+udp://{shown}:{receiver.getsockname()[1]}")
        store.open("p", TABLES)
        store.write([StoreRow(0, T0, 1, [7])], [])
        assert receiver.recv(100) == f"s,plant=p v=7i {T0}\n".encode()


def test_unknown_host_is_noticed_by_udp_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", fail)
    with pytest.raises(StoreError, match="nowhere: Name or service not known"):
        InfluxStore("influx+udp://nowhere").open("p", TABLES)


@pytest.mark.net
def test_server_that_is_not_there_may_come(tmp_path: Path) -> None:
    store = InfluxStore("influx+http://127.0.0.1:1/write")
    with pytest.raises(StoreError, match="refused") as caught:
        store.open("p", TABLES)
    assert not caught.value.is_final
