"""What a station runs, and what is kept of it for the next start: both change together.

Rule 1: what is to run is kept first, then the engine is asked; what it refuses is kept no longer.
So a kill at any moment leaves a whole configuration, the old or the new one.
Rule 2: an engine that goes away in the middle is not trusted to have taken anything: what ran
before is kept, and told again to the engine that comes after.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any, Protocol

from eap.appliance.configuration import Configuration, Stored, digest_of
from eap.appliance.store import Store
from eap.device.fault import DeviceFault, FaultCode
from eap.device.rollout import without_alternates
from eap.errors import EngineGoneError, EngineRefusedError, EnvironmentalError
from eap.pd.device import DeviceState
from eap.pd.spec import StationSpec

logger = logging.getLogger(__name__)


class StationEngine(Protocol):
    """Who runs stations.

    Both methods raise EngineRefusedError, EngineGoneError or EnvironmentalError.
    """

    async def configure(self, station: str, spec: StationSpec) -> None:
        """Have *station* run *spec* from its next cycle on."""

    async def set_state(self, station: str, state: DeviceState) -> None:
        """Bring *station* to PreOp, SafeOp or Op."""


class StationKeeper:
    """What one station runs.

    Args:
        spec: What the engine was started with.
        state: Likewise.
        store: Where it is kept.
        engine: Who runs it.

    Attributes:
        spec: What it runs.
        state: In which state.
        objects: The content of its dictionaries, where that was kept.
        previous: What it ran before, None if nothing else.
        on_change: Called with a new specification once it runs.
    """

    def __init__(
        self, spec: StationSpec, state: DeviceState, store: Store, engine: StationEngine
    ) -> None:
        self.spec = spec
        self.state = state
        self.objects: dict[str, Any] = {}
        self.previous: Configuration | None = None
        self.on_change: Callable[[StationSpec], None] | None = None
        self._store = store
        self._engine = engine
        self._base = digest_of(spec)
        self._applied = ""
        self._is_unsure = False
        stored = store.load(spec.name)
        if stored is not None:
            self._base, self._applied = stored.base, stored.applied
            self.previous = stored.previous
            if stored.spec == spec:
                self.objects = stored.objects

    async def change(
        self, spec: StationSpec, objects: dict[str, Any], *, applied: bool = False
    ) -> None:
        """Run *spec*, with what the dictionaries hold then.

        Args:
            spec: What is to run.
            objects: The content of its dictionaries.
            applied: Whether *spec* is what a plant file says, alternates aside.

        Raises:
            DeviceFault: it does not run, and what ran before goes on.
        """
        bare, bare_before = without_alternates(spec), without_alternates(self.spec)
        # A step of a change that is under way is no configuration to go back to.
        is_same = bare == bare_before and objects == self.objects
        before = Configuration(base=self._base, spec=bare_before, objects=self.objects)
        previous = self.previous if is_same else before
        record = Stored(
            base=self._base,
            spec=spec,
            objects=objects,
            state=self.state,
            previous=previous,
            applied=digest_of(bare) if applied and not is_same else self._applied,
        )
        try:
            await self._save(record)
            if spec != self.spec or self._is_unsure:
                await self._engine.configure(self.spec.name, spec)
        except (EngineRefusedError, EngineGoneError, EnvironmentalError) as exc:
            self._is_unsure = isinstance(exc, EngineGoneError)
            await self._save_back()
            raise DeviceFault(FaultCode.NOT_RUNNING, str(exc)) from None
        self._is_unsure = False
        self.objects, self.previous, self._applied = objects, previous, record.applied
        if spec != self.spec:
            self.spec = spec
            if self.on_change is not None:
                self.on_change(spec)

    async def change_state(self, state: DeviceState) -> None:
        """Bring the station to *state*.

        Raises:
            DeviceFault: the engine does not go up there; what goes down is down in any case.
        """
        if state is self.state:
            return
        try:
            await self._engine.set_state(self.spec.name, state)
        except (EngineRefusedError, EngineGoneError, EnvironmentalError) as exc:
            if state > self.state:
                raise DeviceFault(FaultCode.NOT_RUNNING, str(exc)) from None
            self._is_unsure = True
            logger.warning("station %s, on the way to %s: %s", self.spec.name, state.name, exc)
        self.state = state
        try:
            await self._save(self._record())
        except EnvironmentalError as exc:
            logger.warning("%s; after a start it will be in another state", exc)

    async def tell_again(self) -> None:
        """Tell an engine that was started again what it may not know."""
        if not self._is_unsure:
            return
        try:
            await self._engine.configure(self.spec.name, self.spec)
            await self._engine.set_state(self.spec.name, self.state)
        except (EngineRefusedError, EngineGoneError, EnvironmentalError) as exc:
            logger.warning("station %s, after a start of the engine: %s", self.spec.name, exc)
        else:
            self._is_unsure = False

    def _record(self) -> Stored:
        return Stored(
            base=self._base,
            spec=self.spec,
            objects=self.objects,
            state=self.state,
            previous=self.previous,
            applied=self._applied,
        )

    async def _save(self, record: Stored) -> None:
        # Other clients do not wait for the disk.
        await asyncio.to_thread(self._store.save, self.spec.name, record)

    async def _save_back(self) -> None:
        try:
            await self._save(self._record())
        except EnvironmentalError as exc:
            logger.warning("%s", exc)
