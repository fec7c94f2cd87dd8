"""Requests of services to the supervisor: descriptors, refusals, and replies that do not come."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable

import pytest

from eap.errors import EnvironmentalError
from eap.runtime.handover import NO_DESCRIPTOR, PortName, SharedSocket, SocketKind
from eap.runtime.passing import CloseSocket, OpenSocket, SupervisorRequests
from eap.services.supervisor_link import SupervisorLink
from tests.support.eventually import settle

WANTED = SharedSocket(
    SocketKind.TCP, "127.0.0.1", 34980, owners=(PortName("left", "eap0"),)
)  # fmt: skip

Script = Callable[[SupervisorLink, SupervisorRequests], Awaitable[None]]


def run(script: Script, reply_s: float = 60) -> None:
    async def serve() -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            link = SupervisorLink(ours, reply_s=reply_s)
            try:
                await script(link, SupervisorRequests(theirs))
            finally:
                link.close()

    asyncio.run(serve())


async def request_of(requests: SupervisorRequests) -> OpenSocket:
    await settle()
    request = requests.receive()
    assert isinstance(request, OpenSocket)
    return request


def test_open_returns_the_descriptors_of_the_reply():
    async def script(link: SupervisorLink, requests: SupervisorRequests) -> None:
        opening = asyncio.ensure_future(link.open(WANTED))
        request = await request_of(requests)
        assert request.socket == WANTED.key
        with socket.socket() as sock:
            # The reply to a process that ended comes first: its descriptor is closed.
            requests.reply(request.id - 1, {"services_fd": sock.fileno()})
            requests.reply(request.id, {"services_fd": sock.fileno()})
            opened = await opening
            assert (opened.key, opened.owners) == (WANTED.key, WANTED.owners)
            assert opened.engine_fd == NO_DESCRIPTOR
            with socket.socket(fileno=opened.services_fd) as copy:
                copy.bind(("127.0.0.1", 0))
                assert copy.getsockname() == sock.getsockname()
        link.close_socket(opened)
        assert requests.receive() == CloseSocket(WANTED.key)

    run(script)


def test_open_raises_the_reason_of_a_refusal():
    async def script(link: SupervisorLink, requests: SupervisorRequests) -> None:
        opening = asyncio.ensure_future(link.open(WANTED))
        requests.refuse((await request_of(requests)).id, "TCP 127.0.0.1:34980 is in use")
        with pytest.raises(EnvironmentalError, match="is in use"):
            await opening

    run(script)


def test_open_raises_when_the_supervisor_does_not_answer():
    async def script(link: SupervisorLink, requests: SupervisorRequests) -> None:
        with pytest.raises(EnvironmentalError, match="does not answer"):
            await link.open(WANTED)

    run(script, reply_s=0.01)
