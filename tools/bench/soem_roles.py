"""The reference master: SOEM in C, by way of pysoem, with the same work as ``bus_roles``."""

from __future__ import annotations

from time import perf_counter_ns
from typing import Any

import pysoem

from tools.bench.buses import FILE
from tools.bench.pacing import answer

_TIMEOUT_US = 2_000_000


def acyclic(job: dict[str, Any]) -> None:
    """Scan, read an object, write a file; answer with the nanoseconds of each."""
    scans, reads, files = [], [], []
    master = pysoem.Master()
    master.open(job["interface"])
    try:
        for _ in range(job["scans"]):
            begin = perf_counter_ns()
            count = master.config_init()
            scans.append(perf_counter_ns() - begin)
        if master.state_check(pysoem.PREOP_STATE, _TIMEOUT_US) != pysoem.PREOP_STATE:
            raise RuntimeError("SOEM does not bring the slaves to PREOP")
        first = master.slaves[0]
        for _ in range(job["reads"]):
            begin = perf_counter_ns()
            first.sdo_read(0x1018, 1)
            reads.append(perf_counter_ns() - begin)
        content = bytes(job["size"])
        for _ in range(job["files"]):
            begin = perf_counter_ns()
            first.foe_write(FILE, 0, content, _TIMEOUT_US)
            files.append(perf_counter_ns() - begin)
        master.state = pysoem.INIT_STATE
        master.write_state()
        master.state_check(pysoem.INIT_STATE, _TIMEOUT_US)
    finally:
        master.close()
    answer({"slaves": count, "scan": scans, "read": reads, "file": files})
