"""Reports of a child process, read as the supervisor does."""

from __future__ import annotations

import os

import msgspec

from eap.runtime.startup import Report


def read_reports(fd: int) -> list[Report]:
    """Return all reports up to the one that it runs, or to the end of the process."""
    data = b""
    while b'"ready"' not in data and (more := os.read(fd, 65536)):
        data += more
    return [msgspec.json.decode(line, type=Report) for line in data.splitlines() if line]
