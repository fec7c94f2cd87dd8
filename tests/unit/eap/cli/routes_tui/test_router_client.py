from __future__ import annotations

from contextlib import ExitStack

import pytest

from eap.cli.routes_tui.table import RouterClient, Snapshot
from eap.errors import ControlError
from tests.support.controlstub import ControlStub
from tests.support.fakeroutes import FakeRoutes


def test_router_client_fetches_adds_removes_and_tests(runtime) -> None:
    fake = FakeRoutes()
    with ExitStack() as stack:
        ControlStub("line", list(fake.stations), fake.table(), stack)
        client = RouterClient("line")
        snapshot = client.fetch("press")
        assert [(each.plant, each.routes.station) for each in snapshot.routers] == [
            ("line", "island-01"), ("line", "island-02")
        ]  # fmt: skip
        router = snapshot.routers[0]
        assert [row.name for row in router.routes.routes] == ["press"]
        assert len(router.routes.requests) == 2
        assert client.add(router, {"name": "shadow", "net_id": "1.1.1.1.1.1", "via": "udp:x"})
        client.remove(router, "shadow", "", "")
        assert client.test(router, "island-02").ok
        with pytest.raises(ControlError, match="no route 'far'"):
            client.test(router, "far")


def test_router_client_without_an_answer_returns_a_problem(runtime) -> None:
    assert RouterClient("hall").fetch("") == Snapshot(
        [], f"no plant hall runs: start one with 'eapctl run PLANT' (looked in {runtime})"
    )
