"""Files that a plant file names, by their paths from its folder on."""

from __future__ import annotations

from pathlib import Path

from eap.config.finding import FindingReport

_FILE = "a file, its path from the plant file on"


def whole_path(folder: Path, file: str) -> str:
    """Return the path of *file* from *folder* on as a whole; empty stays so."""
    return str((folder / file).resolve()) if file else ""


def check_file(path: str, file: str, report: FindingReport, folder: Path) -> None:
    """Report *file*, named at *path*, if it is given and cannot be read."""
    if file and (reason := unreadable_reason(folder / file)):
        report.add(path, f"{file}: {reason}", _FILE)


def unreadable_reason(file: Path) -> str:
    """Return the reason that *file* cannot be read as a whole; empty if it can."""
    try:
        # A directory gets its usual error from open(); a pipe would block it.
        if file.exists() and not file.is_file() and not file.is_dir():
            return "no regular file"  # a pipe would keep us waiting
        with file.open("rb") as opened:
            opened.read(1)
    except (OSError, ValueError) as exc:  # ValueError: a NUL in the path
        return f"{exc.strerror if isinstance(exc, OSError) else exc}"
    return ""
