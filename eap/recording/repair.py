"""End of a recording whose recorder was killed: what is whole stays, the rest is cut off."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO, BinaryIO

from eap.errors import LocalProtocolError, MalformedError
from eap.recording.capture_file import PACKET, CaptureFile, is_capture

_SEARCHED = 16 << 20
_MOST_CUT = 4 << 20
"""Bytes that a killed recorder leaves incomplete at most, a chunk; a power cut may leave zeros."""


def is_being_written(path: Path) -> bool:
    """Return whether a recorder has *path* open: writers lock their files."""
    with path.open("rb") as file:
        return not lock(file)


def finish_recording(path: Path) -> int:
    """Give *path* the end that its recorder did not write; return the bytes that were cut off.

    A finished file is left as it is, and one that is damaged before its end, too.

    Raises:
        OSError: the file cannot be read or written.
        LocalProtocolError: a recorder is writing it.
        MalformedError: it is no recording, or more than its end is damaged.
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
        file.seek(capture.whole_until)
        if (at := _next_packet(file.read(_SEARCHED))) is not None:
            follow = capture.whole_until + at
            raise _damaged_within(
                path, capture.whole_until, f"packets follow at {follow}"
            ) from None
        file.truncate(capture.whole_until)
        os.fsync(file.fileno())
        return size - capture.whole_until
    return 0


def _next_packet(rest: bytes) -> int | None:
    """Return where two whole packets of a pcapng file follow each other in *rest*, if they do."""
    begin = PACKET.to_bytes(4, "little")
    at = rest.find(begin)
    while at >= 0:
        second = _end_of_packet(rest, at)
        if second and rest[second : second + 4] == begin and _end_of_packet(rest, second):
            return at
        at = rest.find(begin, at + 4)
    return None


def _end_of_packet(rest: bytes, at: int) -> int:
    """Return the offset behind the block at *at*, 0 if it is not whole."""
    size = int.from_bytes(rest[at + 4 : at + 8], "little")
    is_whole = (
        size >= 32 and not size % 4 and rest[at + size - 4 : at + size] == rest[at + 4 : at + 8]
    )
    return at + size if is_whole else 0


def _damaged_within(path: Path, at: int, follow: str) -> MalformedError:
    return MalformedError(
        f"damaged, and {follow}: nothing is cut off; 'eapctl export' writes what comes before",
        layout=str(path),
        offset=at,
    )


def _finish_values(file: BinaryIO, path: Path) -> int:
    # Here, because mcap is an extra, which recordings of frames do not need.
    from eap.recording.mcap_end import end_of_file
    from eap.recording.mcap_file import McapFile

    content = McapFile(path)
    if content.is_finished:
        return 0
    size = os.fstat(file.fileno()).st_size
    file.seek(content.whole_until)
    if size - content.whole_until > _MOST_CUT and any(file.read(_MOST_CUT)):
        follow = f"{size - content.whole_until} bytes follow"
        raise _damaged_within(path, content.whole_until, follow)
    keep, end = end_of_file(content)
    file.truncate(keep)
    file.seek(keep)
    file.write(end)
    file.flush()
    os.fsync(file.fileno())
    return max(0, size - content.whole_until)
