"""Keys of a running station: read from its file, and again when that changes."""

from __future__ import annotations

import sys
from pathlib import Path

from eap.config.pd_keys import read_keys
from eap.errors import EnvironmentalError
from eap.pd.authentication import Keys


class KeyFile:
    """The file with the keys of one station.

    A station without readable keys runs: what it signs is counted as not authentic by its
    receivers, and it accepts nothing that has to be signed.

    Args:
        station: Its name, for messages.
        path: The file; empty for a station without keys.

    Attributes:
        keys: Those that were read last.
    """

    def __init__(self, station: str, path: str) -> None:
        self._station = station
        self._path = path
        self.keys = Keys()
        self._seen: object = None
        self.look()

    def look(self) -> None:
        """Read the file again if it has changed; one that cannot be read leaves the keys."""
        if not self._path or (mark := self._mark()) == self._seen:
            return
        self._seen = mark
        try:
            self.keys = read_keys(Path(self._path))
        except EnvironmentalError as exc:
            kept = "those of before are used" if self.keys.by_number else "it has no keys"
            sys.stderr.write(f"engine: keys of station {self._station}: {exc}; {kept}\n")

    def _mark(self) -> object:
        try:
            status = Path(self._path).stat()
        except (OSError, ValueError) as exc:
            return str(exc)
        return status.st_ino, status.st_mtime_ns, status.st_size, status.st_mode
