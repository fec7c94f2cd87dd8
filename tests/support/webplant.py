"""A plant behind a control connection without processes, and the page's server on it."""

from __future__ import annotations

import asyncio
import copy
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

from aiohttp import ClientResponse, ClientWebSocketResponse, encode_basic_auth
from aiohttp.test_utils import TestClient, TestServer
from msgspec.structs import replace

from eap.ams.spec import Role
from eap.config.users import AccountSection
from eap.config.web_sections import SetPanel, TrendPanel, ValuePanel, WebPage, WebSection
from eap.control.protocol import ErrorCode, ValuesEvent
from eap.errors import ControlError
from eap.live.client import LiveClient
from eap.live.transport import ValuesSubscription
from eap.live.view import LiveView
from eap.web.server import PageServer
from tests.support.passwords import HASH, PASSWORD
from tests.support.statusdocument import document, rx

KEY = bytes(32)
VARIABLES = [
    {"name": "speed", "type": "REAL", "writer": "engine", "unit": "1/min", "comment": ""},
    {"name": "setpoint", "type": "UINT", "writer": "application", "unit": "1/min", "comment": ""},
    {"name": "far", "type": "UINT", "writer": "engine", "unit": "", "comment": ""},
]


class StubPlant:
    """Control connection of a plant ``line`` with the station ``mixer`` (PlantConnection).

    Attributes:
        values: Present values.
        quality: Of those that are received.
        written: Parameters of all writes.
        answers: False while it does not answer.
    """

    def __init__(self) -> None:
        self.values: dict[str, Any] = {"speed": 50.5, "setpoint": 40, "far": 7}
        self.quality: dict[str, int | None] = {"far": 3}
        self.rx = rx("from-mill")
        self.written: list[dict[str, Any]] = []
        self.answers = True
        self.cycle = 0

    async def request(self, method: str, params: dict[str, Any]) -> Any:
        if not self.answers:
            raise ControlError("it closed the connection", code=ErrorCode.UNAVAILABLE)
        return copy.deepcopy(getattr(self, f"_{method}")(params))

    async def watch(self, wanted: ValuesSubscription) -> AsyncGenerator[ValuesEvent | ControlError]:
        while self.answers:
            yield ValuesEvent(**self._read({"names": wanted.names}), skipped=0)
            await asyncio.sleep(wanted.period_ms / 1000)
        raise ControlError("it closed the connection", code=ErrorCode.UNAVAILABLE)

    async def close(self) -> None:
        pass

    def _status(self, params: dict[str, Any]) -> dict[str, Any]:
        found = document(rx=[self.rx], cycle_age_us=100, cycle=self.cycle, overruns=0)
        return {"plant": "line", "version": 1, "processes": found["processes"],
                "stations": found["stations"]}  # fmt: skip

    def _variables(self, params: dict[str, Any]) -> list[dict[str, Any]]:
        return VARIABLES

    def _pd_list(self, params: dict[str, Any]) -> list[dict[str, Any]]:
        variables = [{"name": "far", "type": "UINT", "unit": "", "writer": "engine"}]
        return [
            {"station": "mixer", "direction": "rx", "name": "from-mill", "id": 1, "version": 0,
             "length": 2, "port": "eap0", "poll": None, "publisher": "5.1.1.2.2.1",
             "variables": variables}
        ]  # fmt: skip

    def _read(self, params: dict[str, Any]) -> dict[str, Any]:
        self.cycle += 1
        for name in params["names"]:
            if name not in self.values:
                raise ControlError(f"no variable {name!r}", code=ErrorCode.UNKNOWN_NAME)
        values = {name: self.values[name] for name in params["names"]}
        quality = {name: each for name, each in self.quality.items() if name in values}
        return {"station": "mixer", "cycle": self.cycle, "values": values, "quality": quality}

    def _write(self, params: dict[str, Any]) -> dict[str, Any]:
        self.written.append(params)
        for name, value in params["values"].items():
            if not isinstance(value, int) or not 0 <= value <= 65535:
                raise ControlError(f"variable {name}: {value} is no UINT", code=ErrorCode.VALUE)
            self.values[name] = value
        return {"written": 1}

    def _note_logins(self, params: dict[str, Any]) -> dict[str, Any]:
        return {"noted": sum(each.count for each in params["refused"])}


def user(name: str, role: Role, password: str = HASH) -> AccountSection:
    return AccountSection(name=name, role=role, password=password)


USERS = (user("vera", Role.VIEWER), user("otto", Role.OPERATOR), user("elsa", Role.ENGINEER))


def page(*panels: Any, name: str = "Line") -> WebPage:
    return WebPage(name=name, panels=panels)


OPEN = WebSection(
    pages=(
        page(
            ValuePanel(of="mixer/*"),
            TrendPanel(of="mixer/speed", window="10m"),
            SetPanel(of="mixer/setpoint", low=10, high=90),
        ),
    )
)
CLOSED = replace(OPEN, users=USERS)
SETPOINT = "/api/v1/mixer/setpoint"


class Site:
    """The page's server of a stub plant, and clients of it."""

    def __init__(self, plant: StubPlant, server: PageServer, test_server: TestServer) -> None:
        self.plant = plant
        self.server = server
        self._test_server = test_server
        self._clients: list[TestClient[Any, Any]] = []

    async def client(self) -> TestClient[Any, Any]:
        """Return a client with cookies of its own."""
        client: TestClient[Any, Any] = TestClient(self._test_server)
        self._clients.append(client)
        return client

    async def log_in(self, name: str) -> tuple[TestClient[Any, Any], dict[str, str]]:
        """Return a browser that has logged in, and the header of its changes."""
        client = await self.client()
        origin = {"Origin": f"http://{client.host}:{client.port}"}
        before = await (await client.get("/api/v1/session")).json()
        body = {"user": name, "password": PASSWORD}
        headers = origin | {"X-CSRF-Token": before["csrf"]}
        async with client.post("/api/v1/login", json=body, headers=headers) as answer:
            assert answer.status == 200, await answer.text()
            return client, origin | {"X-CSRF-Token": (await answer.json())["csrf"]}


def stub_client(plant: StubPlant | None = None) -> LiveClient:
    """Return the client of a stub plant."""
    found = plant or StubPlant()

    async def connect() -> StubPlant:
        return found

    return LiveClient(connect)


@asynccontextmanager
async def site(section: WebSection, plant: StubPlant | None = None) -> AsyncIterator[Site]:
    """Serve the page of a stub plant, whose variables are known when the block begins."""
    plant = plant or StubPlant()
    view = LiveView(remote={"line": stub_client(plant)})
    async with asyncio.timeout(60), view:
        server = PageServer(section, view, KEY)
        test_server = TestServer(server.application())
        await test_server.start_server()
        found = Site(plant, server, test_server)
        try:
            while not server.feed.directories:  # noqa: ASYNC110  the server does not tell it
                await asyncio.sleep(0.01)
            yield found
        finally:
            for client in found._clients:
                await client.close()
            await test_server.close()


def play(
    script: Callable[[Site], Awaitable[None]],
    section: WebSection = OPEN,
    plant: StubPlant | None = None,
) -> None:
    """Run *script* on the page of a stub plant."""

    async def run() -> None:
        async with site(section, plant) as found:
            await script(found)

    asyncio.run(run())


def basic(name: str, password: str) -> dict[str, str]:
    """Return the header of a program that logs in with each request."""
    return {"Authorization": encode_basic_auth(name, password)}


async def reason(answer: ClientResponse) -> str:
    """Return the message of a refusal."""
    message: str = (await answer.json())["error"]["message"]
    return message


async def subscribed(client: TestClient[Any, Any], *topics: str) -> ClientWebSocketResponse:
    """Open a WebSocket and subscribe it to *topics*."""
    socket = await client.ws_connect("/api/v1/ws")
    welcome = await socket.receive_json()
    assert (welcome["type"], welcome["version"], welcome["plant"]) == ("welcome", 1, "line")
    await socket.send_json({"subscribe": topics})
    return socket


async def of_type(socket: ClientWebSocketResponse, kind: str) -> dict[str, Any]:
    """Return the next message of a type; others are skipped."""
    message: dict[str, Any]
    while (message := await socket.receive_json())["type"] != kind:
        pass
    return message
