"""An engine that takes configurations and states, and does what a test tells it to."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from eap.appliance.station_device import StationDevice
from eap.appliance.station_keeper import StationKeeper
from eap.appliance.store import Store
from eap.device.eap_content import Identity
from eap.device.live import NothingRuns
from eap.errors import EapError
from eap.pd.device import DeviceState
from eap.pd.spec import StationSpec


class StationEngine:
    """Fits the engine's client by its shape.

    Attributes:
        spec: What it runs.
        state: In which state.
        calls: What it was asked for, in order.
        failure: Raised by the next call.
        asked: Set once it was asked for something.
        gate: What it waits for before it does anything.
    """

    def __init__(self, spec: StationSpec, state: DeviceState = DeviceState.OP) -> None:
        self.spec = spec
        self.state = state
        self.calls: list[str] = []
        self.failure: EapError | None = None
        self.asked = asyncio.Event()
        self.gate: asyncio.Event | None = None

    async def configure(self, station: str, spec: StationSpec) -> None:
        await self._note(f"configure {station}")
        self.spec = spec

    async def set_state(self, station: str, state: DeviceState) -> None:
        await self._note(f"{station} {state.name}")
        self.state = state

    async def _note(self, call: str) -> None:
        self.calls.append(call)
        self.asked.set()
        if self.gate is not None:
            await self.gate.wait()
        if self.failure is not None:
            failure, self.failure = self.failure, None
            raise failure


def make_device(
    spec: StationSpec, state: DeviceState = DeviceState.OP, plant: str = "demo"
) -> tuple[StationDevice, StationEngine]:
    """Return a device and the engine that it asks."""
    engine = StationEngine(spec, state)
    keeper = StationKeeper(spec, state, Store(plant), engine)
    return StationDevice(keeper, NothingRuns(), Identity(device_name="test")), engine


def while_serving(device: StationDevice, script: Callable[[], Awaitable[Any]]) -> Any:
    """Run *script* while *device* serves, and return what it does."""

    async def run() -> Any:
        serving = asyncio.ensure_future(device.serve())
        try:
            return await script()
        finally:
            serving.cancel()

    return asyncio.run(run())
