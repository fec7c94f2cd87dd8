"""Control protocol by ADS: pyads as a foreign client, and our own as the live view uses it."""

from __future__ import annotations

import asyncio
import ctypes
import json
import struct
from collections.abc import Awaitable, Callable, Iterator
from contextlib import aclosing
from functools import partial
from typing import Any

import pytest

from eap.control.protocol import READ, WRITE, ErrorCode, ValuesEvent
from eap.errors import ControlError
from eap.live.ads_connection import AdsConnection, RemoteHost
from eap.live.client import LiveClient
from eap.live.rows import station_rows
from eap.live.transport import ValuesSubscription
from eap.live.view import LiveView
from tests.support.appliance import Appliance, Plants, plants

pyads = pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = pytest.mark.net

HOST = "127.9.44.1"
CONTROL_PORT, CONTROL, REQUEST, PART = 17_729, 0x4541_5002, 0, 1
PLANT = f"""\
plant: remote
defaults: {{cycle_us: 10000}}
stations:
  - name: open
    net_id: {HOST}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{HOST}", net_id: {HOST}.2.1}}
    variables:
      ticks: UDINT
      setpoint: {{type: UINT, default: 5}}
      label: {{type: STRING(8), default: new}}
    sources: {{ticks: {{kind: counter}}}}
  - name: viewed
    net_id: 127.9.44.2.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.9.44.2", net_id: 127.9.44.2.2.1}}
    variables: {{level: UINT}}
    access: [{{name: look, deny: [write], transports: [ams-tcp, "udp:eap0"]}}]
  - name: hidden
    net_id: 127.9.44.3.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.9.44.3", net_id: 127.9.44.3.2.1}}
    variables: {{level: UINT}}
    access: [{{name: closed, deny: [all], transports: [ams-tcp]}}]
"""


@pytest.fixture(scope="module")
def folder() -> Iterator[Plants]:
    with plants() as found:
        found.state = found.folder / "state"
        yield found


@pytest.fixture(scope="module")
def plant(folder: Plants) -> Appliance:
    return folder.run(folder.write(PLANT))


@pytest.fixture
def foreign(plant: Appliance) -> Iterator[Any]:
    connection = pyads.Connection(f"{HOST}.1.1", CONTROL_PORT, HOST)
    with connection:
        yield connection


def exchange(connection: Any, offset: int, data: bytes, length: int) -> tuple[int, int, bytes]:
    """Return ticket, total and data of an answer; the layout is that of docs/ads.md."""
    written = (ctypes.c_ubyte * len(data))(*data)
    got = connection.read_write(
        CONTROL, offset, ctypes.c_ubyte * length, written, ctypes.c_ubyte * len(data),
        check_length=False,
    )  # fmt: skip
    octets = bytes(got)
    ticket, total = struct.unpack_from("<II", octets)
    return ticket, total, octets[8:]


def line(method: str, **params: Any) -> bytes:
    return json.dumps({"v": 1, "id": 7, "method": method, "params": params}).encode()


def test_pyads_sends_a_request_and_gets_its_answer(foreign: Any) -> None:
    ticket, total, data = exchange(foreign, REQUEST, line("hello"), 60_000)
    answer = json.loads(data[:total])
    assert (ticket, answer["id"], answer["result"]["plant"]) == (0, 7, "remote")
    assert answer["result"]["stations"] == ["open", "viewed"]


def test_pyads_fetches_a_long_answer_in_parts(foreign: Any) -> None:
    ticket, total, data = exchange(foreign, REQUEST, line("status"), 1008)
    assert ticket
    assert total > 2000
    whole = data[:1000]
    while len(whole) < total:
        again, _, data = exchange(foreign, PART, struct.pack("<II", ticket, len(whole)), 1008)
        assert again == ticket
        whole += data[: min(1000, total - len(whole))]
    names = [each["name"] for each in json.loads(whole)["result"]["stations"]]
    assert names == ["open", "viewed"]
    with pytest.raises(pyads.ADSError, match="1804"):  # not found: it was fetched to its end
        exchange(foreign, PART, struct.pack("<II", ticket, 0), 1008)


@pytest.mark.parametrize(
    ("request_line", "code"),
    [
        (b"hello", "bad_request"),
        (b'{"v": 2, "method": "hello"}', "version"),
        (line("write", station="open", values={"setpoint": 1}), "unknown_method"),
        (line("stop"), "unknown_method"),
        (line("read", station="hidden"), "refused"),
        (line("read", station="nowhere"), "unknown_name"),
        (line("read", station="open", names=["tick"]), "unknown_name"),
        (b"[" * 70_000, "bad_request"),
    ],
)
def test_refused_request_has_the_error_of_the_control_protocol(
    foreign: Any, request_line: bytes, code: str
) -> None:
    _, total, data = exchange(foreign, REQUEST, request_line, 60_000)
    assert json.loads(data[:total])["error"]["code"] == code


def test_other_operations_are_refused_by_ads_errors(foreign: Any) -> None:
    with pytest.raises(pyads.ADSError, match="1794"):  # index group
        foreign.read(0xF005, 0, ctypes.c_ubyte)
    with pytest.raises(pyads.ADSError, match="1795"):  # index offset
        exchange(foreign, 9, b"", 100)
    with pytest.raises(pyads.ADSError, match="1797"):  # size
        exchange(foreign, PART, b"abc", 100)


def play(script: Callable[[LiveClient], Awaitable[None]], host: str = HOST) -> None:
    async def run() -> None:
        client = LiveClient(partial(AdsConnection.open, RemoteHost.parse(host)))
        try:
            async with asyncio.timeout(60):
                await script(client)
        finally:
            await client.close()

    asyncio.run(run())


def test_remote_view_shows_the_stations_that_may_be_read(plant: Appliance) -> None:
    async def run() -> None:
        client = LiveClient(partial(AdsConnection.open, RemoteHost.parse(HOST)))
        async with asyncio.timeout(60), LiveView(remote={HOST: client}) as view:
            report = await view.take()
            assert [row.name for row in station_rows(report.status)] == ["open", "viewed"]
            assert report.unreachable == {}

    asyncio.run(run())


def test_remote_client_reads_writes_and_watches(plant: Appliance) -> None:
    async def script(client: LiveClient) -> None:
        values = {"setpoint": 77, "label": "grün"}
        assert (await client.call(WRITE, station="open", values=values)).written == 2
        found = await client.call(READ, station="open", names=["setpoint", "label"])
        assert found.values == values
        wanted = ValuesSubscription(station="open", names=("ticks",), period_ms=20)
        async with aclosing(client.watch(wanted)) as events:
            first, second = await anext(events), await anext(events)
        assert isinstance(first, ValuesEvent)
        assert isinstance(second, ValuesEvent)
        assert second.values["ticks"] > first.values["ticks"]

    play(script)


@pytest.mark.parametrize(
    ("station", "values", "code"),
    [
        ("open", {"setpoint": -1}, ErrorCode.VALUE),
        ("open", {"setpiont": 1}, ErrorCode.UNKNOWN_NAME),
        ("open", {"ticks": 1}, ErrorCode.REFUSED),
        ("viewed", {"level": 1}, ErrorCode.REFUSED),
        ("hidden", {"level": 1}, ErrorCode.REFUSED),
    ],
)
def test_remote_write_is_refused_by_value_writer_or_rule(
    plant: Appliance, station: str, values: dict[str, Any], code: ErrorCode
) -> None:
    async def script(client: LiveClient) -> None:
        with pytest.raises(ControlError) as refused:
            await client.call(WRITE, station=station, values=values)
        assert refused.value.code == code

    play(script)


def test_remote_write_and_denied_read_are_audited(plant: Appliance, folder: Plants) -> None:
    async def script(client: LiveClient) -> None:
        await client.call(WRITE, station="open", values={"setpoint": 78})
        with pytest.raises(ControlError):
            await client.call(READ, station="hidden")

    play(script)
    text = (folder.folder / "state" / "remote" / "audit.jsonl").read_text()
    written, denied = [json.loads(each) for each in text.splitlines()][-2:]
    assert (written["operation"], written["value"], written["allowed"]) == ("Write", "4e00", True)
    assert (denied["station"], denied["operation"]) == ("hidden", "ReadWrite")
    assert (denied["service"], denied["allowed"]) == ("read", False)


def test_routers_of_another_host_are_shown_and_not_changed(plant: Appliance) -> None:
    pytest.importorskip("textual")
    from eap.cli.routes_tui.table import RemoteRouters

    routers = RemoteRouters([HOST, "127.9.44.9"])
    found = routers.fetch("")
    assert [(each.plant, each.routes.station) for each in found.routers] == [
        ("remote", "open"),
        ("remote", "viewed"),
    ]
    assert found.problem.startswith("127.9.44.9: ")
    with pytest.raises(ControlError, match="open runs on another host"):
        routers.add(found.routers[0], {})


@pytest.mark.parametrize(
    ("host", "reason"),
    [
        ("127.9.44.9", "no AMS router answers"),
        ("127.9.44.9:127.9.44.9.1.1", "cannot be reached at port 48898"),
        (f"{HOST}:127.9.44.8.1.1", "no route to that NetID"),
        (f"{HOST}:{HOST}.2.1", "nothing has that AMS port"),
    ],
)
def test_remote_client_says_why_it_has_no_connection(
    plant: Appliance, host: str, reason: str
) -> None:
    async def script(client: LiveClient) -> None:
        with pytest.raises(ControlError, match=reason):
            await client.request("hello")

    play(script, host)


@pytest.mark.parametrize("text", ["", "127.9.44.1.1.1", "host:", "host:5.1.2"])
def test_remote_address_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        RemoteHost.parse(text)
