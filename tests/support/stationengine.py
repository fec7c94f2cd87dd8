"""An engine that takes configurations and states, and does what a test tells it to."""

from __future__ import annotations

import asyncio

from eap.device.eap_dictionary import DeviceIdentity, NoLiveValues
from eap.errors import EapError, EngineGoneError
from eap.pd.device import DeviceState
from eap.pd.spec import StationSpec
from eap.runtime.store import StationStore
from eap.services.device.station_device import StationDevice
from eap.services.device.station_keeper import StationKeeper


class StationEngine:
    """Fits the engine's client by its shape.

    Attributes:
        spec: What it runs.
        state: In which state.
        calls: What it was asked for, in order.
        failure: Raised by the next call.
        gone: Whether an EngineGoneError was raised.
        asked: Set once it was asked for something.
        gate: What it waits for before it does anything.
    """

    def __init__(self, spec: StationSpec, state: DeviceState = DeviceState.OP) -> None:
        self.spec = spec
        self.state = state
        self.calls: list[str] = []
        self.failure: EapError | None = None
        self.gone = False
        self.asked = asyncio.Event()
        self.gate: asyncio.Event | None = None

    async def configure(self, station: str, spec: StationSpec) -> None:
        await self._note(f"configure {station}")
        self.spec = spec

    async def set_state(self, station: str, state: DeviceState) -> None:
        is_stop = state < self.state  # which an engine does not refuse
        await self._note(f"{station} {state.name}", EngineGoneError if is_stop else EapError)
        self.state = state

    async def _note(self, call: str, can_fail: type[EapError] = EapError) -> None:
        self.calls.append(call)
        self.asked.set()
        if self.gate is not None:
            await self.gate.wait()
        if isinstance(self.failure, can_fail):
            failure, self.failure = self.failure, None
            self.gone = isinstance(failure, EngineGoneError)
            raise failure


def make_device(
    spec: StationSpec,
    state: DeviceState = DeviceState.OP,
    *,
    engine: StationEngine | None = None,
) -> tuple[StationDevice, StationEngine]:
    """Return a device of the plant ``demo`` and the engine that it asks."""
    engine = engine or StationEngine(spec, state)
    store = StationStore("demo", spec.name)
    keeper = StationKeeper(spec, state, store.configuration, engine)
    identity = DeviceIdentity(device_name="test")
    return StationDevice(keeper, NoLiveValues(), identity, store.draft), engine
