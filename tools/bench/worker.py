"""One process of a measurement: ``python -m tools.bench.worker MODULE.FUNCTION JOB``.

*JOB* is JSON.  A module is imported only in the process that needs it: it may not be installed.
"""

from __future__ import annotations

import gc
import importlib
import os
import sys
from typing import Any

import msgspec


def main() -> None:
    """Run the role on its core, without garbage collection as the engine does."""
    module, _, name = sys.argv[1].partition(".")
    job: dict[str, Any] = msgspec.json.decode(sys.argv[2])
    os.sched_setaffinity(0, {job["cpu"]})
    gc.disable()
    getattr(importlib.import_module(f"tools.bench.{module}"), name)(job)


if __name__ == "__main__":
    main()
