"""Routes that were added while a station ran: one file per station, replaced in one step."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import msgspec

from eap.aoe.spec import RouteSpec
from eap.appliance.durable import put_aside, replace_file, seal, unseal
from eap.appliance.runtime import folder_name
from eap.appliance.store import VARIABLE, state_root
from eap.errors import ConfigError, EnvironmentalError

VERSION = 1
FOLDER = "routes"

logger = logging.getLogger(__name__)


class RouteStore:
    """The added routes of one station.

    Args:
        plant: Name of the plant.
        station: Name of the station.
    """

    def __init__(self, plant: str, station: str) -> None:
        self.path = state_root() / folder_name(plant) / FOLDER / f"{folder_name(station)}.json"
        self._station = station

    def load(self) -> tuple[RouteSpec, ...]:
        """Return what is kept, nothing if that cannot be used.

        A damaged file is put aside under its name with ``.damaged``, and a warning says so.
        """
        try:
            data = self.path.read_bytes()
        except FileNotFoundError:
            return ()
        except OSError as exc:
            logger.warning(
                "station %s: its added routes in %s cannot be read (%s)",
                self._station,
                self.path,
                exc.strerror,
            )
            return ()
        try:
            return _decode(data)
        except ConfigError as exc:
            aside = self.path.with_suffix(".damaged")
            logger.warning(
                "station %s: its added routes in %s cannot be used: %s; the file is kept as %s",
                self._station,
                self.path,
                exc,
                aside.name,
            )
            put_aside(self.path, aside)
            return ()

    def save(self, routes: Sequence[RouteSpec]) -> None:
        """Keep *routes*, in the place of what there was.

        Raises:
            EnvironmentalError: they cannot be written; what there was is still there.
        """
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            replace_file(self.path, seal(msgspec.json.encode(routes), VERSION))
        except OSError as exc:
            raise EnvironmentalError(
                f"station {self._station}: routes cannot be kept in {self.path}: {exc.strerror};"
                f" set {VARIABLE} to a directory that you may write"
            ) from None


def _decode(data: bytes) -> tuple[RouteSpec, ...]:
    try:
        return msgspec.json.decode(unseal(data, VERSION), type=tuple[RouteSpec, ...])
    except msgspec.MsgspecError as exc:
        raise ConfigError(f"it holds no routes: {exc}") from None
