"""Configurations that outlive the appliance: one file per station, replaced in one step.

Rule 1: a station that was never configured while it ran has no file.
Rule 2: a file is written beside the old one, synced and renamed, so that whatever happens one of
the two is there, and whole.
Rule 3: who edits the plant file has the last word: what was stored before that does not run, and
is kept for a rollback.  A file that was applied while the station ran is not edited since.
"""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from msgspec.structs import replace

from eap.appliance.configuration import (
    Configuration,
    Stored,
    decode_stored,
    digest_of,
    encode_stored,
    new_cause,
)
from eap.appliance.durable import put_aside, replace_file
from eap.appliance.runtime import folder_name
from eap.device.rollout import without_alternates
from eap.errors import ConfigError, EnvironmentalError
from eap.pd.device import DeviceState
from eap.pd.spec import StationSpec

VARIABLE = "EAP_STATE_DIR"
_FULL = frozenset((errno.ENOSPC, errno.EDQUOT))

logger = logging.getLogger(__name__)


class Effective(NamedTuple):
    """What a station is to run."""

    spec: StationSpec
    state: DeviceState


def state_root() -> Path:
    """Return where configurations are kept.

    EAP_STATE_DIR, else ``$XDG_STATE_HOME/eap``, else ``/var/lib/eap`` for root, else
    ``~/.local/state/eap``.
    """
    if given := os.environ.get(VARIABLE):
        return Path(given)
    if base := os.environ.get("XDG_STATE_HOME"):
        return Path(base) / "eap"
    if os.geteuid() == 0:
        return Path("/var/lib/eap")
    return Path.home() / ".local/state/eap"


class Store:
    """The configurations of the stations of one plant."""

    def __init__(self, plant: str) -> None:
        self.path = state_root() / folder_name(plant)

    def file(self, station: str) -> Path:
        """Return the file of one station."""
        return self.path / f"{folder_name(station)}.json"

    def load(self, station: str) -> Stored | None:
        """Return what is stored of *station*, None if nothing is that can be used.

        A damaged file is put aside under its name with ``.damaged``, and a warning says so.
        """
        path = self.file(station)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as exc:
            logger.warning(
                "station %s: its configuration in %s cannot be read (%s); the plant file runs",
                station,
                path,
                exc.strerror,
            )
            return None
        try:
            return decode_stored(data)
        except ConfigError as exc:
            aside = path.with_suffix(".damaged")
            logger.warning(
                "station %s: its configuration in %s cannot be used: %s; it is kept as %s, and the"
                " plant file runs",
                station,
                path,
                exc,
                aside.name,
            )
            put_aside(path, aside)
            return None

    def save(self, station: str, stored: Stored) -> None:
        """Keep *stored*, in the place of what there was.

        Raises:
            EnvironmentalError: it cannot be written; what there was is still there.
        """
        path = self.file(station)
        try:
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            replace_file(path, encode_stored(stored))
        except OSError as exc:
            remedy = (
                "make room there"
                if exc.errno in _FULL
                else f"set {VARIABLE} to a directory that you may write"
            )
            raise EnvironmentalError(
                f"station {station}: its configuration cannot be kept in {path}: {exc.strerror};"
                f" {remedy}"
            ) from None

    def set_aside(self, station: str) -> bool:
        """Let *station* start as if it had never been configured; tell whether it had been.

        Raises:
            EnvironmentalError: the file cannot be renamed.
        """
        return self._rename(self.file(station), self._aside(station))

    def bring_back(self, station: str) -> bool:
        """Undo ``set_aside``, unless *station* was configured again; tell whether that was done.

        Raises:
            EnvironmentalError: the file cannot be renamed.
        """
        path = self.file(station)
        return not path.exists() and self._rename(self._aside(station), path)

    def _aside(self, station: str) -> Path:
        return self.file(station).with_suffix(".before")

    def _rename(self, path: Path, target: Path) -> bool:
        try:
            path.replace(target)
        except FileNotFoundError:
            return False
        except OSError as exc:
            raise EnvironmentalError(f"{path} cannot be renamed: {exc.strerror}") from None
        return True


def settle(
    plant: str, stations: Iterable[StationSpec], state: DeviceState = DeviceState.OP
) -> None:
    """Make up what is stored for a start of the appliance with *stations* of the plant file.

    While it runs, what counts is the file that it was started with, and what was applied on top;
    now what was applied last is that file, or there is another one.  Arguments as for *effective*.
    """
    store, cause = Store(plant), new_cause()
    for spec in stations:
        stored = store.load(spec.name)
        if stored is None or not stored.applied:
            continue
        base = digest_of(spec)
        if stored.applied == base:
            made_up = replace(stored, base=base)
        else:
            made_up = _settled(stored, Stored(base=base, spec=spec, state=state, cause=cause))
        if made_up != stored:
            _keep(store, spec.name, made_up)


def effective(
    plant: str, stations: Iterable[StationSpec], state: DeviceState = DeviceState.OP
) -> tuple[Effective, ...]:
    """Return what *stations* of the plant file are to run, each in the state asked for last.

    Args:
        plant: Its name.
        stations: As the plant file has them.
        state: Of stations that were never asked for another.
    """
    store, cause = Store(plant), new_cause()
    return tuple(_effective(store, spec, state, cause) for spec in stations)


def _effective(store: Store, spec: StationSpec, state: DeviceState, cause: str) -> Effective:
    stored = store.load(spec.name)
    if stored is None:
        return Effective(spec, state)
    base = digest_of(spec)
    if stored.base == base:
        return Effective(stored.spec, stored.state)
    settled = _settled(stored, Stored(base=base, spec=spec, state=state, cause=cause))
    _keep(store, spec.name, settled)
    return Effective(settled.spec, settled.state)


def _keep(store: Store, station: str, stored: Stored) -> None:
    try:
        store.save(station, stored)
    except EnvironmentalError as exc:
        logger.warning("%s", exc)


def _settled(stored: Stored, file: Stored) -> Stored:
    """Return *stored* with what the plant file says in force."""
    bare = without_alternates(stored.spec)
    if bare == file.spec:  # the file has caught up with what was configured
        return replace(stored, base=file.base, spec=bare, applied="")
    logger.warning(
        "station %s: the plant file was edited since it was configured; the file runs, and what ran"
        " before is kept for a rollback",
        file.spec.name,
    )
    if bare != stored.spec and not stored.undone:  # it ends a change that was broken off
        return replace(file, previous=stored.previous, cause=stored.cause)
    previous = Configuration(base=stored.base, spec=bare, objects=stored.objects)
    return replace(file, previous=previous)
