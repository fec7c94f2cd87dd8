from __future__ import annotations

import asyncio
import socket
import threading

import pytest

from eap.services.transports import ams_tcp
from eap.services.transports.ams_tcp import resolve

pytestmark = pytest.mark.net


def test_resolve_returns_an_address_as_it_is() -> None:
    assert asyncio.run(resolve("10.1.2.3")) == "10.1.2.3"


def test_names_are_looked_up() -> None:
    assert asyncio.run(resolve("localhost")) == "127.0.0.1"


@pytest.mark.parametrize("host", ["no.such.host.invalid", "a" * 300, "a..b"])
def test_unknown_name_is_an_error(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    original = socket.gethostbyname

    def look_up(name: str) -> str:
        if name.endswith(".invalid"):
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return original(name)

    monkeypatch.setattr(ams_tcp.socket, "gethostbyname", look_up)
    with pytest.raises(OSError, match=r"not known|not a host name"):
        asyncio.run(resolve(host))


def test_resolve_slow_name_server_does_not_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither who gives up waiting, nor the end of the process."""
    entered, leave = threading.Event(), threading.Event()

    def look_up(name: str) -> str:
        entered.set()
        leave.wait(10)
        return "10.0.0.1"

    monkeypatch.setattr(ams_tcp.socket, "gethostbyname", look_up)

    async def run() -> None:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.05):
                await resolve("slow")

    asyncio.run(run())
    assert entered.is_set()
    leave.set()
