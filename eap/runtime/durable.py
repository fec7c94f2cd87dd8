"""Durable files: replaced in one step, and checked for completeness when read.

A file is JSON: a version, a digest, and the content under ``content``.  The digest reveals a file
that was damaged or edited by hand.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import msgspec

from eap.errors import ConfigError, EnvironmentalError

logger = logging.getLogger(__name__)


class _File(msgspec.Struct, frozen=True):
    """The file."""

    version: int
    digest: str
    content: msgspec.Raw


def seal(content: bytes, version: int) -> bytes:
    """Return the bytes of a file that holds *content*, which is JSON."""
    return msgspec.json.encode(_File(version, digest(content), msgspec.Raw(content)))


def unseal(data: bytes, version: int) -> bytes:
    """Return the content of a file; raise ConfigError with the reason if it is invalid."""
    try:
        file = msgspec.json.decode(data, type=_File)
    except ValueError as exc:
        raise ConfigError(f"it is not whole: {exc}") from None
    if file.version != version:
        raise ConfigError(f"its version is {file.version}, this release knows {version}")
    content = bytes(file.content)
    if file.digest != digest(content):
        raise ConfigError("its content is not what was written")
    return content


def digest(content: bytes) -> str:
    """Return the SHA-256 digest of *content*."""
    return hashlib.sha256(content).hexdigest()


def replace_file(path: Path, data: bytes) -> None:
    """Replace the content of *path* by *data*; after any failure one of the two is there, whole.

    Raises:
        OSError: it cannot be written; the old content is still there.
    """
    temporary = path.with_suffix(".new")  # what a kill leaves behind is overwritten next time
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            # Before the rename: else a loss of power may leave the new name with no content.
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(folder)  # the name, too, is to survive a loss of power
    finally:
        os.close(folder)


@contextmanager
def whole_file(target: Path) -> Iterator[BinaryIO]:
    """Open a file that takes the place of *target* once the block is through, and it is on disk.

    Its rights stay as they are.  A pipe or a device is written as it is.

    Raises:
        EnvironmentalError: it cannot be written; the old content is still there.
    """
    # Behind a symbolic link: the rename would replace the link itself.
    whole = target.resolve()
    partial = whole.with_name(f".{whole.name}.{os.getpid()}")
    try:
        if whole.exists() and not whole.is_file():
            with whole.open("wb") as file:
                yield file
            return
        # A rename needs rights in the folder only, and would replace a file that is read only.
        if whole.exists() and not os.access(whole, os.W_OK):
            raise PermissionError(errno.EACCES, "it is read only")
        try:
            with partial.open("wb") as file:
                if whole.exists():
                    os.fchmod(file.fileno(), stat.S_IMODE(whole.stat().st_mode))
                yield file
                file.flush()
                os.fsync(file.fileno())
            partial.replace(whole)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as exc:
        raise EnvironmentalError(f"{target} cannot be written: {exc.strerror}") from None


def put_aside(path: Path, aside: Path) -> None:
    """Rename a file that cannot be used; a failure is a warning."""
    try:
        path.replace(aside)
    except OSError as exc:
        logger.warning("%s cannot be renamed: %s", path, exc.strerror)
