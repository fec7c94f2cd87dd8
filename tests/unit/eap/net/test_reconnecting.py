from __future__ import annotations

import asyncio
import socket

import pytest

from eap.net.reconnecting import Backoff, ReconnectingLink, ReconnectPolicy, connect_tcp


def test_backoff_grows_to_limit_and_resets() -> None:
    backoff = Backoff(0.5, 3)
    for _ in range(2):
        for longest in (0.5, 1, 2, 3, 3):
            assert longest / 2 <= backoff.next_s() <= longest
        backoff.reset()


def test_waits_differ() -> None:
    assert len({Backoff(1, 2).next_s() for _ in range(10)}) > 5


class Link(ReconnectingLink):
    """Link whose connections end for the reasons of a list; an empty list ends it."""

    def __init__(self, reasons: list[str], pauses: ReconnectPolicy) -> None:
        super().__init__(pauses)
        self.reasons = reasons
        self.reported: list[tuple[str, bool]] = []

    async def _connect(self) -> str:
        return self.reasons.pop(0)

    def _disconnected(self, reason: str, *, has_lasted: bool) -> bool:
        self.reported.append((reason, self._is_new_reason(reason)))
        return bool(reason)

    def _is_wanted(self) -> bool:
        return bool(self.reasons)


def test_reconnecting_link_reconnects_until_orderly_end() -> None:
    link = Link(["refused", "refused", "silent", ""], ReconnectPolicy(0.001, 0.001, 10))
    asyncio.run(asyncio.wait_for(link.run(), 10))
    reported = [("refused", True), ("refused", False), ("silent", True), ("", True)]
    assert link.reported == reported
    assert link.reason == ""


def test_link_that_is_no_longer_wanted_ends_after_the_pause() -> None:
    link = Link(["refused"], ReconnectPolicy(0.001, 0.001, 10))
    asyncio.run(asyncio.wait_for(link.run(), 10))
    assert link.reported == [("refused", True)]


@pytest.mark.net
def test_connect_tcp_has_the_kernel_look_after_a_silent_peer() -> None:
    async def scene() -> socket.socket:
        port = listener.getsockname()[1]
        return await connect_tcp("127.0.0.1", port, None, timeout_s=5, unconfirmed_s=10)

    with socket.create_server(("127.0.0.1", 0)) as listener, asyncio.run(scene()) as sock:
        options = [
            sock.getsockopt(socket.IPPROTO_TCP, option)
            for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
        ]
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        assert options == [30, 10, 3]
        assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 10_000


@pytest.mark.net
def test_connect_tcp_to_a_closed_port_is_refused() -> None:
    async def scene() -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        with pytest.raises(ConnectionRefusedError):
            await connect_tcp("127.0.0.1", port, None, timeout_s=5, unconfirmed_s=10)

    asyncio.run(scene())
