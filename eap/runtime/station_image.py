"""The process image of a station that may be configured anew while it runs.

A station whose layout changes gets a new image; the old one is marked as retired, and stays as it
was.  Whoever keeps an image for long asks here for the newest one each time.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eap.net.image_file import ImageFile, open_image
from eap.pd.image import Image
from eap.pd.spec import Writer


class StationImage:
    """The newest process image of one station.

    Raises:
        ImageError: there is none.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = open_image(path)
        self._writers: set[Writer] = set()

    def close(self) -> None:
        """Let go of the file, and of the right to write."""
        self._file.close()

    @property
    def image(self) -> Image:
        """Named access to the newest image; raise ImageError if it cannot be opened."""
        return self.file.image

    @property
    def file(self) -> ImageFile:
        """The newest file; raises as :attr:`image` does."""
        if self._file.retired:
            self._move()
        return self._file

    def acquire_writer(self, writer: Writer) -> None:
        """Become the one who writes the region of *writer*, in newer images too.

        Raises:
            WriterConflictError: someone else is it already.
            ImageError: the image cannot be opened.
        """
        self.file.acquire_writer(writer)
        self._writers.add(writer)

    def release_writer(self, writer: Writer) -> None:
        """Give up the right to write the region of *writer*."""
        self._writers.discard(writer)
        self._file.release_writer(writer)

    def write(self, writer: Writer, values: Mapping[str, Any]) -> None:
        """Write *values* at once; none is lost when the image changes meanwhile.

        The caller is the region's writer.

        Raises:
            ValueError: a value does not fit its type; nothing was written.
            ImageError: there is no such variable (any more); nothing was written.
        """
        while True:
            file = self.file
            octets = {name: file.image.encode(name, value) for name, value in values.items()}
            with file.image.writing(writer):
                for name, each in octets.items():
                    file.image.store(name, each)
            if not file.retired:
                return

    def write_once(self, writer: Writer, values: Mapping[str, Any]) -> None:
        """Write *values* at once, as the region's writer for just as long as that takes.

        Raises:
            WriterConflictError: someone else is it.
            ValueError, ImageError: as :meth:`write` does.
        """
        self.acquire_writer(writer)
        try:
            self.write(writer, values)
        finally:
            self.release_writer(writer)

    def catch_up(self) -> bool:
        """Look for a newer image where none was announced; return whether there is one."""
        if not self._file.has_lost_its_name:
            return False
        self._move()
        return True

    def _move(self) -> None:
        fresh = open_image(self._path)
        try:
            for writer in self._writers:
                fresh.acquire_writer(writer)
        except BaseException:
            fresh.close()
            raise
        self._file.close()
        self._file = fresh
