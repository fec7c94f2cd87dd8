"""End of a recording whose recorder was killed: what is whole stays, the rest is cut off."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO, BinaryIO

from eap.errors import LocalProtocolError, MalformedError
from eap.recording.capture_file import CaptureFile, is_capture


def is_being_written(path: Path) -> bool:
    """Return whether a recorder has *path* open: writers lock their files."""
    with path.open("rb") as file:
        return not lock(file)


def finish_recording(path: Path) -> int:
    """Give *path* the end that its recorder did not write; return the bytes that were cut off.

    A finished file is left as it is.

    Raises:
        OSError: the file cannot be read or written.
        LocalProtocolError: a recorder is writing it.
        MalformedError: it is no recording.
    """
    with path.open("r+b") as file:
        if not lock(file):
            raise LocalProtocolError(
                f"{path} is being recorded: stop the recording first (eapctl record list)"
            )
        return _finish_frames(file, path) if is_capture(path) else _finish_values(file, path)


def lock(file: IO[bytes]) -> bool:
    """Hold *file* until it is closed, or return False if another process holds it."""
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True  # a file system without locks
    return True


def _finish_frames(file: BinaryIO, path: Path) -> int:
    capture = CaptureFile(file, str(path))
    try:
        for _ in capture.packets():
            pass
    except MalformedError:
        size = os.fstat(file.fileno()).st_size
        if not capture.whole_until:
            raise
        file.truncate(capture.whole_until)
        os.fsync(file.fileno())
        return size - capture.whole_until
    return 0


def _finish_values(file: BinaryIO, path: Path) -> int:
    # Here, because mcap is an extra, which recordings of frames do not need.
    from eap.recording.mcap_end import end_of_file
    from eap.recording.mcap_file import McapFile

    content = McapFile(path)
    if content.is_finished:
        return 0
    size = os.fstat(file.fileno()).st_size
    keep, end = end_of_file(content)
    file.truncate(keep)
    file.seek(keep)
    file.write(end)
    file.flush()
    os.fsync(file.fileno())
    return max(0, size - content.whole_until)
