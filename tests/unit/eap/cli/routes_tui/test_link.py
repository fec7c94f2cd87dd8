from __future__ import annotations

from contextlib import ExitStack

import pytest

from eap.cli.routes_tui.table import RouterClient, Snapshot
from eap.errors import ControlError
from tests.support.controlstub import ControlStub
from tests.support.fakeroutes import FakeRoutes


def test_link_looks_and_works(runtime) -> None:
    fake = FakeRoutes()
    with ExitStack() as stack:
        ControlStub("line", list(fake.stations), fake.table(), stack)
        link = RouterClient("line")
        picture = link.look("press")
        assert [(each.plant, each.routes.station) for each in picture.routers] == [
            ("line", "island-01"), ("line", "island-02")
        ]  # fmt: skip
        router = picture.routers[0]
        assert [row.name for row in router.routes.routes] == ["press"]
        assert len(router.routes.requests) == 2
        assert link.add(router, {"name": "shadow", "net_id": "1.1.1.1.1.1", "via": "udp:x"})
        link.remove(router, "shadow", "", "")
        assert link.test(router, "island-02").ok
        with pytest.raises(ControlError, match="no route 'far'"):
            link.test(router, "far")


def test_what_does_not_answer_is_a_problem_and_no_error(runtime) -> None:
    assert RouterClient("hall").look("") == Snapshot(
        [], f"no plant hall runs: start one with 'eapctl run PLANT' (looked in {runtime})"
    )
