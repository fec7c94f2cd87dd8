"""The reference master: SOEM in C, by way of pysoem, with the same work as ``bus_roles``."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter_ns
from typing import Any

import pysoem

from tools.bench.buses import FILE
from tools.bench.network import Page
from tools.bench.pacing import answer, run_phases

_TIMEOUT_US = 2_000_000
_PROCESS_DATA_US = 20_000
_ATTEMPTS, _EXCHANGES = 1000, 50
_ACKNOWLEDGE = 0x10


def cycles(job: dict[str, Any]) -> None:
    """Bring all slaves to OP; then send process data and receive it, again and again."""
    words = Page(Path(job["page"])).words
    done = 0
    master = pysoem.Master()
    master.open(job["interface"])
    try:
        slaves = master.config_init()
        master.config_map()
        master.state_check(pysoem.SAFEOP_STATE, _TIMEOUT_US)
        expected = master.expected_wkc

        def exchange() -> bool:
            nonlocal done
            master.send_processdata()
            is_good = master.receive_processdata(_PROCESS_DATA_US) == expected
            done += is_good
            return bool(is_good)

        exchange()  # outputs are valid before OP is requested
        for number in range(_ATTEMPTS):
            if number % _EXCHANGES == 0:  # again: on a busy machine a watchdog may have intervened
                master.state = pysoem.OP_STATE | _ACKNOWLEDGE
                master.write_state()
            exchange()
            if master.state_check(pysoem.OP_STATE, _PROCESS_DATA_US) == pysoem.OP_STATE:
                break
        else:
            raise RuntimeError("SOEM does not bring the slaves to OP")
        answer({"slaves": slaves, "rates": run_phases(words, job, exchange, lambda: done)})
    finally:
        master.close()


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
