"""What is kept of one station in a file of its own, replaced in one step."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

from eap.appliance.durable import put_aside, replace_file, seal, unseal
from eap.appliance.runtime import folder_name
from eap.appliance.store import VARIABLE, state_root
from eap.errors import ConfigError, EnvironmentalError

VERSION = 1
T = TypeVar("T")

logger = logging.getLogger(__name__)


class StationFile(Generic[T]):
    """A file with one value.

    Args:
        plant: Name of the plant.
        station: Name of the station.
        folder: Of all files of this kind.
        kind: Type of the value, as msgspec takes it.
        what: It is, in words.
    """

    def __init__(self, plant: str, station: str, folder: str, kind: Any, what: str) -> None:
        self.path = state_root() / folder_name(plant) / folder / f"{folder_name(station)}.json"
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
            self._warn(f"cannot be read ({exc.strerror})")
            return None
        try:
            return self._decode(data)
        except ConfigError as exc:
            aside = self.path.with_suffix(".damaged")
            self._warn(f"cannot be used: {exc}; the file is kept as {aside.name}")
            put_aside(self.path, aside)
            return None

    def save(self, value: T) -> None:
        """Keep *value*, in the place of what there was.

        Raises:
            EnvironmentalError: it cannot be written; what there was is still there.
        """
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            replace_file(self.path, seal(msgspec.json.encode(value), VERSION))
        except OSError as exc:
            raise EnvironmentalError(
                f"station {self._station}: {self._what} cannot be kept in {self.path}:"
                f" {exc.strerror}; set {VARIABLE} to a directory that you may write"
            ) from None

    def set_aside(self) -> None:
        """Let the station start as if nothing had been kept; a warning says if that failed."""
        if self.path.exists():
            put_aside(self.path, self._aside)

    def bring_back(self) -> None:
        """Undo ``set_aside``, unless something was kept since."""
        if self._aside.exists() and not self.path.exists():
            put_aside(self._aside, self.path)

    @property
    def _aside(self) -> Path:
        return self.path.with_suffix(".before")

    def _decode(self, data: bytes) -> T:
        try:
            value: T = msgspec.json.decode(unseal(data, VERSION), type=self._kind)
        except msgspec.MsgspecError as exc:
            raise ConfigError(f"it holds no {self._what}: {exc}") from None
        return value

    def _warn(self, text: str) -> None:
        logger.warning("station %s: %s in %s %s", self._station, self._what, self.path, text)
