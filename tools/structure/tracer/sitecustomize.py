"""Counter of calls of the project's functions, loaded by Python where this folder is in its path.

SIGUSR1 begins to count, SIGUSR2 writes the counts into ``$STRUCTURE_TRACE``.  With
``$STRUCTURE_FROM_START`` a process counts from its start to its end.
"""

from __future__ import annotations

import atexit
import json
import os
import signal
import sys
from collections import Counter
from pathlib import Path
from types import CodeType, FrameType

_FOLDER = os.environ.get("STRUCTURE_TRACE", "")
_ROOT = os.environ.get("STRUCTURE_ROOT", "") + "/"
_calls: Counter[CodeType] = Counter()


def _profile(frame: FrameType, event: str, _: object) -> None:
    if event == "call" and not _is_importing(frame):
        _calls[frame.f_code] += 1


def _is_importing(frame: FrameType | None) -> bool:
    """Return whether *frame* runs because a module is imported."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _begin(*_: object) -> None:
    _calls.clear()
    sys.setprofile(_profile)


def _write(*_: object) -> None:
    sys.setprofile(None)
    rows = [
        (code.co_filename.removeprefix(_ROOT), code.co_qualname, count)
        for code, count in _calls.items()
        if code.co_filename.startswith(_ROOT)
    ]
    path = Path(_FOLDER, f"{os.getpid()}.part")
    path.write_text(json.dumps(rows))
    path.rename(path.with_suffix(".json"))


if _FOLDER:
    signal.signal(signal.SIGUSR1, _begin)
    signal.signal(signal.SIGUSR2, _write)
    if os.environ.get("STRUCTURE_FROM_START"):
        atexit.register(_write)
        _begin()
