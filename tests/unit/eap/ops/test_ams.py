from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from eap.control.protocol import ErrorCode
from eap.control.routes import PlantScan, ScanVia, StationEntry, TracedPath
from eap.errors import ControlError
from eap.ops import routing
from tests.support.controlstub import ControlStub


class Plant:
    """An appliance that knows one target."""

    def __init__(self, name: str, stack: ExitStack) -> None:
        self.name = name
        self.stub = ControlStub(
            name, [f"{name}-1"], {"trace": self.trace, "scan": self.scan}, stack
        )

    def trace(self, params: dict[str, Any]) -> TracedPath:
        if params["target"] == "broken":
            raise ControlError("broken", code=ErrorCode.INTERNAL)
        if params["target"] != f"{self.name}-2":
            raise ControlError(f"{self.name} does not know it", code=ErrorCode.UNKNOWN_NAME)
        return TracedPath(params["target"], "", "", True, "", [], None)

    def scan(self, params: dict[str, Any]) -> PlantScan:
        return PlantScan([StationEntry(self.name, "", [], "")], ScanVia(params["via"], ""))


@pytest.fixture
def plants(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Plant]]:
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path))
    with ExitStack() as stack:
        yield [Plant(name, stack) for name in ("line", "press")]


def test_trace_uses_the_appliance_that_knows_the_target(plants: list[Plant]) -> None:
    assert routing.trace("press-2").target == "press-2"
    assert routing.trace("line-2", "line", "line-1").target == "line-2"
    with pytest.raises(ControlError, match="does not know it"):
        routing.trace("x")
    with pytest.raises(ControlError, match="broken"):
        routing.trace("broken")


def test_each_plant_is_scanned_once(plants: list[Plant]) -> None:
    assert [each.stations[0].name for each in routing.scan()] == ["line", "press"]
    assert [each.via.station for each in routing.scan(via="press-1")] == ["press-1"]
