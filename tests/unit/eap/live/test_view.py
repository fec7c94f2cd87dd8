"""The live view of several hosts: what it says of those that do not answer."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest

from eap.errors import ControlError
from eap.live.client import LiveClient
from eap.live.view import LiveReport, LiveView


class Silent:
    """Client of a host that does not answer."""

    def __init__(self, why: str) -> None:
        self._why = why

    async def request(self, method: str, **params: Any) -> dict[str, Any]:
        raise ControlError(self._why)

    async def close(self) -> None:
        """Do nothing."""


@pytest.mark.parametrize(
    ("why", "shown"),
    [("10.0.0.5: no router answers", "no router answers"), ("it is busy", "it is busy")],
)
def test_host_that_does_not_answer_is_named_once(why: str, shown: str) -> None:
    async def take() -> LiveReport:
        async with LiveView(remote={"10.0.0.5": cast("LiveClient", Silent(why))}) as view:
            return await view.take()

    report = asyncio.run(take())
    assert report.unreachable == {"10.0.0.5": shown}
    (event,) = report.events
    assert event.text == f"10.0.0.5: {shown}"
