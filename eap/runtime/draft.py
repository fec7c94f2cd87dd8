"""Draft of a station's configuration: downloads in PreOp that no state change has taken yet.

A file with one line for each download.  It is written before the client is answered, so a services
process that is killed loses none of them; the next one repeats them.  It is not synced: after a
loss of power the stored configuration counts.  The first line names the configuration that the
downloads begin with, and the content of the dictionaries if the file was shortened.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from eap.runtime.durable import put_aside

SHORTEN_AT = 1 << 18
"""Bytes of downloads after which the dictionaries are written in their place."""

logger = logging.getLogger(__name__)


class Download(msgspec.Struct, frozen=True, omit_defaults=True):
    """One download: EAP port, object, bytes; *complete* from *subindex* on."""

    port: str
    index: int
    subindex: int
    data: bytes
    complete: bool = False


class DraftStart(msgspec.Struct, frozen=True, omit_defaults=True):
    """First line: digest of the stored configuration, and what the dictionaries hold instead."""

    base: str
    objects: dict[str, Any] = {}


class Draft(msgspec.Struct, frozen=True):
    """Content of a draft: dictionaries by port, if it has them, and the downloads since."""

    objects: dict[str, Any]
    downloads: list[Download]


class DraftFile:
    """The draft of one station.

    Args:
        path: The file; its folder is made when it is needed.
        station: Name of the station, for warnings.
    """

    def __init__(self, path: Path, station: str) -> None:
        self._path = path
        self._station = station
        self._size = 0
        """Bytes of downloads behind the first line."""
        self._is_open = False
        self._has_failed = False

    def read(self, base: str) -> Draft | None:
        """Return the draft that begins with the configuration *base*, and go on with it.

        A line that a kill has cut is left out; a file that is damaged is put aside.
        """
        try:
            lines = self._path.read_bytes().split(b"\n")
            start = msgspec.json.decode(lines[0], type=DraftStart)
            downloads = [msgspec.json.decode(line, type=Download) for line in lines[1:-1]]
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as exc:
            logger.warning(
                "station %s: downloads in PREOP cannot be read from %s: %s; the stored"
                " configuration counts",
                self._station, self._path, exc,
            )  # fmt: skip
            put_aside(self._path, self._path.with_suffix(".damaged"))
            return None
        if start.base != base:
            return None
        self._is_open = not lines[-1]  # what was cut is overwritten by a new file
        self._size = sum(map(len, lines[1:]))
        return Draft(start.objects, downloads)

    def append(
        self, download: Download, base: str, dump: Callable[[], dict[str, Any]], *, starts: bool
    ) -> None:
        """Add one download that was accepted.

        Args:
            download: It.
            base: Digest of the stored configuration.
            dump: Returns the content of the dictionaries.
            starts: Whether it is the first since that configuration.
        """
        line = msgspec.json.encode(download) + b"\n"
        try:
            if starts or not self._is_open or self._size > SHORTEN_AT:
                self._begin(DraftStart(base, {} if starts else dump()), line if starts else b"")
            else:
                with self._path.open("ab", buffering=0) as file:
                    file.write(line)
                self._size += len(line)
        except OSError as exc:
            if not self._has_failed:
                logger.warning(
                    "station %s: downloads in PREOP cannot be kept in %s: %s; a restart of"
                    " services loses them",
                    self._station, self._path, exc.strerror,
                )  # fmt: skip
            self._has_failed, self._is_open = True, False
        else:
            self._has_failed = False

    def clear(self) -> None:
        """Forget the draft: it was taken, or replaced as a whole."""
        self._is_open = False
        try:
            self._path.unlink(missing_ok=True)
        except OSError as exc:
            logger.warning("%s cannot be removed: %s", self._path, exc.strerror)

    def _begin(self, start: DraftStart, line: bytes) -> None:
        self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        temporary = self._path.with_suffix(".new")
        temporary.write_bytes(msgspec.json.encode(start) + b"\n" + line)
        temporary.replace(self._path)
        self._size, self._is_open = len(line), True
