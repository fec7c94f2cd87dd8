"""Operations on recordings that are there."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct

from eap.errors import ConfigError
from eap.pd.layout import plan_layout
from eap.recording.export import ExportCount, require_frames, write_csv, write_mcap, write_pcapng
from eap.recording.published import RecordedFrame, published_by
from eap.recording.recording_file import open_recording
from eap.recording.rows import TimeWindow, select
from eap.recording.window import parse_window

if TYPE_CHECKING:
    from eap.recording.recording_file import Recording

STDOUT = "-"
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""Errors of a write, which name no file."""


class ExportRequest(Struct, frozen=True, kw_only=True):
    """``eapctl export``: *form* is ``csv``, ``parquet``, ``mcap`` or ``pcapng``."""

    file: Path
    form: str
    target: Path | None = None
    variables: tuple[str, ...] = ()
    begin: str | None = None
    end: str | None = None
    plant: Path | None = None
    is_forced: bool = False


class ExportResult(Struct, frozen=True):
    """Rows (or frames) and columns that were written to *file*."""

    file: str
    form: str
    rows: int
    columns: int
    damaged_chunks: int
    """Parts of a recording of values that could not be read, and are missing."""


def export_recording(request: ExportRequest, stdout: Callable[[str], object]) -> ExportResult:
    """Write a recording in another form, CSV also to *stdout*.

    Raises:
        ConfigError: the times, variables or files do not fit.
        MalformedError: it is no recording.
        OSError: a file cannot be read or written.
        EnvironmentalError: an extra is missing.
    """
    recording = open_recording(request.file, published_in(request.plant))
    window = parse_window(request.begin, request.end, recording.first_ns, recording.last_ns)
    if request.form == "pcapng":
        require_frames(recording)
    target = _target(request)
    if str(target) == STDOUT:
        count = write_csv(recording, window, select(recording.sources, request.variables), stdout)
        return ExportResult(STDOUT, request.form, *count, recording.damaged_chunks)
    if target.exists():
        if not request.is_forced:
            raise ConfigError(f"{target} exists: overwrite it with --force")
        if target.samefile(request.file):
            raise ConfigError(f"{target} is the recording itself: name another file with -o")
    # Written beside it, so that a failure leaves no half of a file behind.
    part = target.with_name(f".{target.name}.part")
    part.unlink(missing_ok=True)
    try:
        count = _write(request, recording, window, part)
        part.replace(target)
    except OSError as exc:
        if exc.filename != str(part) and exc.errno not in _FULL:
            raise
        raise OSError(exc.errno, exc.strerror, str(target)) from None
    finally:
        part.unlink(missing_ok=True)
    return ExportResult(str(target), request.form, *count, recording.damaged_chunks)


def published_in(plant: Path | None) -> tuple[RecordedFrame, ...]:
    """Return the PDs of a plant file, none without a file; raise ConfigError with its findings."""
    if plant is None:
        return ()
    from eap.ops.plant import load_or_raise

    return published_by(map(plan_layout, load_or_raise(plant).stations))


def _target(request: ExportRequest) -> Path:
    if request.target is None:
        target = request.file.with_suffix(f".{request.form}")
        if target == request.file:
            raise ConfigError(f"{target} is the recording itself: name another file with -o")
        return target
    if str(request.target) == STDOUT and request.form != "csv":
        raise ConfigError(f"--{request.form} is not written to stdout: name a file with -o")
    return request.target


def _write(
    request: ExportRequest, recording: Recording, window: TimeWindow, path: Path
) -> ExportCount:
    if request.form == "pcapng":
        return write_pcapng(recording, window, request.variables, path)
    selection = select(recording.sources, request.variables)
    if not selection:
        raise ConfigError(
            f"{request.file} has no variables: name the plant file whose frames are in it with"
            " --plant"
        )
    if request.form == "csv":
        with path.open("x", encoding="utf-8", newline="") as file:
            return write_csv(recording, window, selection, file.write)
    if request.form == "mcap":
        return write_mcap(recording, window, selection, path)
    from eap.recording.parquet import write_parquet

    return write_parquet(recording, window, selection, path)
