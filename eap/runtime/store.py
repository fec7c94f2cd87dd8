"""Store of a station that was changed while it ran: records, and one file for each.

Rule 1: a station that was never changed while it ran has no files.
Rule 2: a file is written beside the old one, synced and renamed, so that after any failure one of
the two is there, and whole.
Rule 3: an edit of the plant file overrides a stored configuration, which then does not run and is
kept for a rollback.  A file that was applied while the station ran does not count as edited.
"""

from __future__ import annotations

import errno
import logging
import os
import time
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import msgspec
from msgspec.structs import replace

from eap.ams.spec import RouteSpec, RoutingSpec
from eap.ams.spec import SpecStruct as AoeRecord
from eap.device.rollout import without_alternates
from eap.errors import ConfigError, EnvironmentalError
from eap.ids import decode_value, encode_value
from eap.pd.device import DeviceState
from eap.pd.spec import SpecRecord, StationSpec
from eap.runtime.draft import DraftFile
from eap.runtime.durable import digest, put_aside, replace_file, seal, unseal
from eap.runtime.folder import folder_name

VARIABLE = "EAP_STATE_DIR"
VERSION = 1
_FULL = frozenset((errno.ENOSPC, errno.EDQUOT))
T = TypeVar("T")

logger = logging.getLogger(__name__)


class Configuration(SpecRecord, frozen=True, kw_only=True):
    """One whole configuration of a station."""

    base: str
    """``digest_of`` the station in the plant file that was in force then."""
    spec: StationSpec
    """Specification that the engine runs."""
    objects: dict[str, Any] = msgspec.field(default_factory=dict)
    """Content of the dictionary of each EAP port, by its name; a port that is missing here has
    what follows from *spec*."""


class Stored(Configuration, frozen=True, kw_only=True):
    """The configuration in force and the one before it."""

    state: DeviceState = DeviceState.OP
    """State requested last."""
    applied: str = ""
    """``digest_of`` the station in the appliance's own plant file, if that was applied while it ran
    (and edited before); empty if it was not."""
    previous: Configuration | None = None
    """For a rollback."""
    cause: str = ""
    """Change that brought it; the same at all stations that one ``apply`` changed."""
    undone: bool = False
    """True if *cause* was rolled back: *previous* is what it had brought."""


_ConfigurationT = TypeVar("_ConfigurationT", bound=Configuration)


class AppliedRouting(AoeRecord, frozen=True, kw_only=True):
    """Routes and access rules that a station was given while it ran.

    Attributes:
        base: Digest of what the plant file said that the appliance was started with.
        spec: The routing in force.
        previous: The routing before, for a rollback.
        cause: Change that brought it, see ``Stored.cause``.
        undone: Whether that change was rolled back: *previous* is what it had brought.
    """

    base: str
    spec: RoutingSpec
    previous: RoutingSpec
    cause: str = ""
    undone: bool = False


class Effective(NamedTuple):
    """Specification and state in which a station starts."""

    spec: StationSpec
    state: DeviceState


def state_root() -> Path:
    """Return the directory of stored configurations.

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


def plant_folder(plant: str) -> Path:
    """Return the folder of the stored files of the stations of *plant*."""
    return state_root() / folder_name(plant)


class StationFile(Generic[T]):
    """A file with one value of a station, replaced in one step.

    Args:
        folder: Of all files of its kind.
        station: Name of the station.
        kind: Type of the value, as msgspec takes it.
        what: Words for the value.
    """

    def __init__(self, folder: Path, station: str, kind: Any, what: str) -> None:
        self.path = folder / f"{folder_name(station)}.json"
        self._station = station
        self._kind = kind
        self._what = what

    def read(self) -> T | None:
        """Return the value, None if there is none that can be used.

        A damaged file is put aside under its name with ``.damaged``, and a warning says so.
        """
        try:
            data = self.path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as exc:
            self._warn(f"cannot be read ({exc.strerror}); the plant file runs")
            return None
        try:
            return self.decode(data)
        except ConfigError as exc:
            aside = self.path.with_suffix(".damaged")
            self._warn(f"cannot be used: {exc}; it is kept as {aside.name}, the plant file runs")
            # Kept, not deleted: a person may still read from it what was configured.
            put_aside(self.path, aside)
            return None

    def save(self, value: T) -> None:
        """Store *value*, replacing the old one.

        Raises:
            EnvironmentalError: it cannot be written; the old value is still there.
        """
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            replace_file(self.path, self.encode(value))
        except OSError as exc:
            remedy = (
                "make room there"
                if exc.errno in _FULL
                else f"set {VARIABLE} to a directory that you may write"
            )
            raise EnvironmentalError(
                f"station {self._station}: {self._what} cannot be kept in {self.path}:"
                f" {exc.strerror}; {remedy}"
            ) from None

    def encode(self, value: T) -> bytes:
        """Return the bytes of the file."""
        return seal(msgspec.json.encode(value, enc_hook=encode_value), VERSION)

    def decode(self, data: bytes) -> T:
        """Decode the bytes of the file; raise ConfigError with the reason if they are invalid."""
        try:
            value: T = msgspec.json.decode(
                unseal(data, VERSION), type=self._kind, dec_hook=decode_value
            )
        except ValueError as exc:
            raise ConfigError(f"it holds no {self._what}: {exc}") from None
        return value

    def set_aside(self) -> bool:
        """Hide the stored file, so that the station starts without it; return whether it existed.

        Raises:
            EnvironmentalError: the file cannot be renamed.
        """
        return self._rename(self.path, self._aside)

    def bring_back(self) -> bool:
        """Undo ``set_aside``, unless a new file was stored since; return whether it was undone.

        Raises:
            EnvironmentalError: the file cannot be renamed.
        """
        return not self.path.exists() and self._rename(self._aside, self.path)

    @property
    def _aside(self) -> Path:
        return self.path.with_suffix(".before")

    def _rename(self, path: Path, target: Path) -> bool:
        try:
            path.replace(target)
        except FileNotFoundError:
            return False
        except OSError as exc:
            raise EnvironmentalError(f"{path} cannot be renamed: {exc.strerror}") from None
        return True

    def _warn(self, text: str) -> None:
        logger.warning("station %s: %s in %s %s", self._station, self._what, self.path, text)


class StationStore:
    """All stored files of one station.

    Attributes:
        configuration: Specification and objects of its devices.
        routes: Routes that were added to those of its router.
        routing: Routes and access rules that were applied.
        draft: Downloads in PreOp that are not part of the configuration yet.
    """

    def __init__(self, plant: str, station: str) -> None:
        folder = plant_folder(plant)
        self.configuration: StationFile[Stored] = StationFile(
            folder, station, Stored, "configuration"
        )
        self.routes: StationFile[tuple[RouteSpec, ...]] = StationFile(
            folder / "routes", station, tuple[RouteSpec, ...], "added routes"
        )
        self.routing: StationFile[AppliedRouting] = StationFile(
            folder / "routing", station, AppliedRouting, "routes and access rules"
        )
        self.draft = DraftFile(folder / "drafts" / f"{folder_name(station)}.jsonl", station)

    def set_aside(self) -> bool:
        """Hide all stored files, so that the plant file alone counts; return whether one existed.

        Raises:
            EnvironmentalError: a file cannot be renamed.
        """
        self.routes.set_aside()
        self.routing.set_aside()
        return self.configuration.set_aside()

    def bring_back(self) -> None:
        """Undo ``set_aside`` for files that were not stored again since.

        Raises:
            EnvironmentalError: a file cannot be renamed.
        """
        for file in (self.configuration, self.routes, self.routing):
            file.bring_back()


def new_cause() -> str:
    """Return a name for a change; those of later changes sort behind it."""
    # Wall-clock time, since it has to grow over restarts of the host too.
    return f"{time.time_ns():020d}"


def digest_of(spec: StationSpec | RoutingSpec) -> str:
    """Return a digest of *spec*.

    Fields that hold their defaults do not count: a release that adds one does not change it.
    """
    return digest(msgspec.json.encode(lean(spec), enc_hook=encode_value))


def adopt_plant_file(
    plant: str, stations: Iterable[StationSpec], state: DeviceState = DeviceState.OP
) -> None:
    """Update the store for a start of the appliance with *stations* of the plant file.

    While the appliance runs, the base is the file that it was started with, plus applied changes.
    At a start the file applied last becomes the base, unless the file was edited since.  Arguments
    as for *effective*.
    """
    cause = new_cause()
    for spec in stations:
        file = StationStore(plant, spec.name).configuration
        stored = file.read()
        if stored is None or not stored.applied:
            continue
        base = digest_of(spec)
        if stored.applied == base:
            updated = replace(stored, base=base)
        elif _is_moved(spec, stored, stored.applied):
            moved = _moved(stored, spec.phase_us, stored.applied, base)
            updated = replace(moved, base=base, applied=base)
        else:
            updated = _with_plant_file(
                stored, Stored(base=base, spec=spec, state=state, cause=cause)
            )
        if updated != stored:
            _keep(file, updated)


def effective(
    plant: str, stations: Iterable[StationSpec], state: DeviceState = DeviceState.OP
) -> tuple[Effective, ...]:
    """Return the specifications to run for *stations* of the plant file, with the last states.

    Args:
        plant: Its name.
        stations: As the plant file has them.
        state: Of stations for which no other state was requested.
    """
    cause = new_cause()
    return tuple(_effective(plant, spec, state, cause) for spec in stations)


def _effective(plant: str, spec: StationSpec, state: DeviceState, cause: str) -> Effective:
    file = StationStore(plant, spec.name).configuration
    stored = file.read()
    if stored is None:
        return Effective(spec, state)
    base = digest_of(spec)
    # The plant file is the one that was configured: the stored state of the station goes on.
    if stored.base == base:
        return Effective(stored.spec, stored.state)
    if _is_moved(spec, stored, stored.base):
        updated = _moved(stored, spec.phase_us, stored.base, base)
    else:
        updated = _with_plant_file(stored, Stored(base=base, spec=spec, state=state, cause=cause))
    _keep(file, updated)
    return Effective(updated.spec, updated.state)


def _is_moved(spec: StationSpec, stored: Stored, base: str) -> bool:
    """Return whether *spec* differs from the one with the digest *base* in its phase alone."""
    # A phase that the file leaves open follows from all of its stations, and a release may derive
    # it in another way: nobody has edited the station then.
    return digest_of(replace(spec, phase_us=stored.spec.phase_us)) == base


def _moved(stored: Stored, phase_us: int, before: str, base: str) -> Stored:
    """Return *stored* with another phase, and *base* for *before*, also for a rollback."""
    own = stored.spec.phase_us

    def moved(each: _ConfigurationT) -> _ConfigurationT:
        spec = replace(each.spec, phase_us=phase_us) if each.spec.phase_us == own else each.spec
        return replace(each, spec=spec, base=base if each.base == before else each.base)

    previous = None if stored.previous is None else moved(stored.previous)
    return replace(moved(stored), previous=previous)


def _keep(file: StationFile[Stored], stored: Stored) -> None:
    try:
        file.save(stored)
    except EnvironmentalError as exc:
        logger.warning("%s", exc)


def _with_plant_file(stored: Stored, file: Stored) -> Stored:
    """Return *stored* with the specification of the plant file in force."""
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


def lean(value: Any) -> Any:
    """Return *value* for JSON, records without the fields that hold their defaults.

    A release that does not know such a field reads it all the same.
    """
    if isinstance(value, msgspec.Struct):
        tag, defaults = _outline(type(value))
        fields: dict[str, Any] = dict(tag)
        for name, key, default in defaults:
            held = getattr(value, name)
            if held != default:
                fields[key] = lean(held)
        return fields
    if isinstance(value, tuple):
        return [lean(each) for each in value]
    return value


@cache
def _outline(
    kind: type[msgspec.Struct],
) -> tuple[tuple[tuple[str, Any], ...], tuple[tuple[str, str, Any], ...]]:
    """Return the tag of records of *kind* with its key; of each field name, key and default."""
    config = kind.__struct_config__
    tag = () if config.tag_field is None else ((config.tag_field, config.tag),)
    fields = msgspec.structs.fields(kind)
    return tag, tuple((field.name, field.encode_name, field.default) for field in fields)
