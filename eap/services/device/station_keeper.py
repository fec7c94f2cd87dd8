"""Configuration that a station runs, and its stored copy for the next start: both change together.

Rule 1: a new configuration is stored first, then requested from the engine; one that the engine
refuses is removed again.  A kill at any moment leaves a whole configuration, the old or the new
one.
Rule 2: an engine that goes away in the middle may have applied nothing: the previous configuration
is stored again, and sent to the next engine.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
from collections.abc import Callable
from pathlib import Path
from time import time
from typing import Any, NamedTuple, Protocol

from msgspec.structs import replace

from eap.device.rollout import without_alternates
from eap.errors import EngineGoneError, EngineRefusedError, EnvironmentalError
from eap.pd.device import DeviceFault, DeviceState, FaultCode
from eap.pd.spec import StationSpec, record_to_lines
from eap.runtime.engine_messages import Configure, SetState
from eap.runtime.store import Configuration, StationFile, Stored, digest_of, new_cause
from eap.services.engine_link import EngineLink

CONFIGURE_S = 60.0
STATE_S = 5.0


class EngineClient:
    """Client of the engine for changes of running stations.

    Args:
        link: Services' end of the pair with the engine.
        folder: Where both may read and write: the appliance's runtime folder.
        pass_sockets: Passes the sockets that a specification needs to the engine.
    """

    def __init__(
        self, link: EngineLink, folder: Path, pass_sockets: Callable[[StationSpec], object]
    ) -> None:
        self._link = link
        self._folder = folder
        self._pass_sockets = pass_sockets
        self._numbers = itertools.count(1)

    async def configure(self, station: str, spec: StationSpec) -> None:
        """Have *station* run *spec* from its next cycle on.

        Raises:
            EngineRefusedError: it goes on with what it ran before; the text says why.
            EngineGoneError: no engine answers, or it was started again meanwhile; one that is
                started runs what has been stored.
            EnvironmentalError: the runtime folder cannot be written.
        """
        # By file: a specification of a thousand PDs is longer than a message of the pair.
        path = self._folder / f".{os.getpid()}-{next(self._numbers)}.spec"
        try:
            path.write_bytes(record_to_lines(spec))
        except OSError as exc:
            path.unlink(missing_ok=True)
            raise EnvironmentalError(f"{path}: {exc.strerror}") from None
        try:
            # Always: an engine that was started again may lack those of the latest change.
            self._pass_sockets(spec)
            await self._link.request(
                lambda number: Configure(id=number, station=station, path=str(path)), CONFIGURE_S
            )
        finally:
            path.unlink(missing_ok=True)

    async def set_state(self, station: str, state: DeviceState) -> None:
        """Bring *station* to PreOp, SafeOp or Op; raises as :meth:`configure` does."""
        await self._link.request(
            lambda number: SetState(id=number, station=station, state=state), STATE_S
        )


logger = logging.getLogger(__name__)


class Unsaved(NamedTuple):
    """Reason that a configuration is not stored, and its start as Unix time."""

    reason: str
    since: float


class StationEngine(Protocol):
    """Interface to the engine that runs stations.

    Both methods raise EngineRefusedError, EngineGoneError or EnvironmentalError.
    """

    async def configure(self, station: str, spec: StationSpec) -> None:
        """Have *station* run *spec* from its next cycle on."""

    async def set_state(self, station: str, state: DeviceState) -> None:
        """Bring *station* to PreOp, SafeOp or Op."""


class PortFollower(Protocol):
    """Part of services that opens and closes what the ports of a station need."""

    async def open(self, spec: StationSpec) -> None:
        """Open what *spec* needs beside what is open; raises EnvironmentalError."""

    async def follow(self, spec: StationSpec) -> None:
        """Use what *spec*, which the station runs, needs, and close the rest."""

    async def discard(self, *, is_engine_gone: bool = False) -> None:
        """Close what was opened for a specification that the station does not run.

        With *is_engine_gone* the next engine may run it; :meth:`discard` is called again then, once
        it does not.
        """


class StationKeeper:
    """Configuration and state that one station runs, and their stored copy.

    Args:
        spec: What the engine was started with.
        state: Likewise.
        store: Where it is kept.
        engine: Who runs it.

    Attributes:
        spec: What it runs.
        state: In which state.
        objects: The content of its dictionaries, where that was kept.
        previous: What it ran before the last change, None if nothing else.
        cause: Which change that was.
        undone: Whether it was taken back.
        on_change: Called with a new specification once it runs.
        followers: Have ports follow the specification, before and behind the engine.
        unsaved: Why what runs is not what a start would bring back; None while both agree.
    """

    def __init__(
        self,
        spec: StationSpec,
        state: DeviceState,
        store: StationFile[Stored],
        engine: StationEngine,
    ) -> None:
        self.spec = spec
        self.state = state
        self.objects: dict[str, Any] = {}
        self.previous: Configuration | None = None
        self.cause = ""
        self.undone = False
        self.on_change: list[Callable[[StationSpec], None]] = []
        self.followers: list[PortFollower] = []
        self.unsaved: Unsaved | None = None
        self._store = store
        self._engine = engine
        self._base = digest_of(spec)
        self._applied = ""
        self._is_engine_unknown = False
        stored = store.read()
        if stored is not None:
            self._base, self._applied = stored.base, stored.applied
            self.previous, self.cause = stored.previous, stored.cause
            self.undone = stored.undone
            if stored.spec == spec:
                self.objects = stored.objects
        self._stored = self._record()

    async def change(
        self, spec: StationSpec, objects: dict[str, Any], *, cause: str = "", applied: bool = False
    ) -> None:
        """Run *spec*, with the content of the dictionaries then.

        Args:
            spec: What is to run.
            objects: The content of its dictionaries.
            cause: What brings it; all steps of one change have the same.  Empty is a new one.
            applied: Whether *spec* is what the appliance's plant file says, or a step towards it.

        Raises:
            DeviceFault: it does not run, and what ran before goes on.
        """
        record = replace(self._record(), spec=spec, objects=objects)
        # Where nothing was kept of the dictionaries yet they hold what follows from what runs.
        is_other = spec != self.spec or objects != (self.objects or objects)
        if is_other and (not cause or cause != self.cause or self.undone):
            cause = cause or new_cause()
            record = replace(
                record, previous=self._running_configuration(), cause=cause, undone=False
            )
        bare = without_alternates(spec)
        if applied and (bare == spec or bare != without_alternates(self.spec)):
            record = replace(record, applied=digest_of(bare))
        await self._run(record)

    async def roll_back(self, spec: StationSpec, objects: dict[str, Any]) -> None:
        """Run *spec*: the configuration before the last change, or a step to or from it.

        What ran until now is what another :meth:`roll_back` brings.  Raises as :meth:`change`.
        """
        record = replace(self._record(), spec=spec, objects=objects)
        if without_alternates(spec) != without_alternates(self.spec):
            record = replace(record, previous=self._running_configuration(), undone=not self.undone)
        await self._run(record)

    def _running_configuration(self) -> Configuration:
        """Return the running configuration, as the target of a later rollback."""
        spec = without_alternates(self.spec)
        return Configuration(base=self._base, spec=spec, objects=self.objects)

    async def _run(self, record: Stored) -> None:
        spec = record.spec
        try:
            for follower in self.followers if spec != self.spec else ():
                await follower.open(spec)
            # Stored before the engine is asked, see rule 1.
            await self._save(record)
            if spec != self.spec or self._is_engine_unknown:
                await self._engine.configure(self.spec.name, spec)
        except (EngineRefusedError, EngineGoneError, EnvironmentalError) as exc:
            self._is_engine_unknown = isinstance(exc, EngineGoneError)
            await self._save_back()
            for follower in self.followers:
                await follower.discard(is_engine_gone=self._is_engine_unknown)
            raise DeviceFault(FaultCode.NOT_RUNNING, str(exc)) from None
        self._is_engine_unknown = False
        self.objects, self.previous, self._applied = record.objects, record.previous, record.applied
        self.cause, self.undone = record.cause, record.undone
        if spec != self.spec:
            self.spec = spec
            for follow in self.on_change:
                follow(spec)
            for follower in self.followers:
                await follower.follow(spec)

    async def change_state(self, state: DeviceState) -> None:
        """Bring the station to *state*.

        Raises:
            DeviceFault: the engine does not go up there; what goes down is down in any case.
        """
        if state is self.state:
            if self.unsaved is not None:
                await self._save_back()
            return
        try:
            await self._engine.set_state(self.spec.name, state)
        except (EngineRefusedError, EngineGoneError, EnvironmentalError) as exc:
            # On the way down the station is stopped in any case: without an engine nothing runs.
            if state > self.state:
                raise DeviceFault(FaultCode.NOT_RUNNING, str(exc)) from None
            self._is_engine_unknown = True
            logger.warning(
                "station %s: %s not requested from the engine: %s", self.spec.name, state.name, exc
            )
        self.state = state
        await self._save_back()

    async def resend(self) -> None:
        """Send the engine the configuration again, which it may have missed."""
        # The engine may have read the stored configuration just before it changed, and services may
        # have been killed between the two.
        try:
            await self._engine.configure(self.spec.name, self.spec)
            await self._engine.set_state(self.spec.name, self.state)
        except (EngineRefusedError, EngineGoneError, EnvironmentalError) as exc:
            logger.warning(
                "station %s: configuration not sent again after a start: %s", self.spec.name, exc
            )
        else:
            self._is_engine_unknown = False
            for follower in self.followers:
                await follower.discard()

    def _record(self) -> Stored:
        return Stored(
            base=self._base,
            spec=self.spec,
            objects=self.objects,
            state=self.state,
            applied=self._applied,
            previous=self.previous,
            cause=self.cause,
            undone=self.undone,
        )

    async def _save(self, record: Stored) -> None:
        # Other clients do not wait for the disk.
        await asyncio.to_thread(self._store.save, record)
        self._stored = record
        self.unsaved = None

    async def _save_back(self) -> None:
        """Store the running configuration; log a failure once, and report it until it succeeds."""
        record = self._record()
        try:
            await self._save(record)
        except EnvironmentalError as exc:
            if self.unsaved is None and record != self._stored:
                logger.warning("%s; a start restores the configuration before", exc)
                self.unsaved = Unsaved(str(exc), time())
