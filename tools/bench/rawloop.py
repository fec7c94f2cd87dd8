"""The raw loop in C, ``rawloop.c``: compiled for a measurement, run like the workers in Python."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, TypeAlias

from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import Command, DatagramHeader
from devicebus.wire.register import Register
from eap.codec.ethercat import ETHERTYPE, EtherCatHeader
from eap.codec.pd import CYCLE_OFFSET, FIRST_PD, PdHeader
from tools.bench.network import ROOT, Cable, Worker
from tools.bench.pacing import ARRIVED_WITHIN_NS, BURST, CYCLE_NS, WINDOW
from tools.bench.stations import ETHERNET_HEADER, Shape, frame_octets

NEEDS = "needs a C compiler"
PREFIX = "c"
"""Module of the names of its roles."""
Process: TypeAlias = AbstractContextManager[Worker]
_SOURCE = ROOT / "tools" / "bench" / "rawloop.c"
_PROGRAM = "rawloop"
SLAVES = 16
"""Of the segment that the program stands for."""
_CONSTANTS = {
    # LINE: the frames of config/solar-line.yaml.
    "ETHERTYPE": ETHERTYPE,
    "CYCLE_AT": ETHERNET_HEADER + CYCLE_OFFSET,
    "DATA_AT": ETHERNET_HEADER + FIRST_PD + PdHeader.SIZE,
    "DATAGRAM_AT": ETHERNET_HEADER + EtherCatHeader.SIZE,
    "DATAGRAM_HEADER": DatagramHeader.SIZE,
    "INDEX_AT": ETHERNET_HEADER + EtherCatHeader.SIZE + 1,
    **{command.name: command.value for command in (Command.LRW, Command.FPRD, Command.BRD)},
    "AL_STATUS": Register.AL_STATUS.value,
    "OP": AlState.OP.value,
    "SLAVES": SLAVES,
    "HEADERS": FIRST_PD + PdHeader.SIZE,
    "LINE_CYCLE_NS": 10_000_000,
    "LINE_SMALL": 26,
    "LINE_SMALL_SIZE": 600,
    "LINE_LARGE": 28,
    "LINE_LARGE_SIZE": 1024,
    "CYCLE_NS": CYCLE_NS,
    "WINDOW": WINDOW,
    "BURST": BURST,
    "ARRIVED_WITHIN_NS": ARRIVED_WITHIN_NS,
}


def is_possible() -> bool:
    """Return whether there is a C compiler."""
    return shutil.which(_compiler()[0]) is not None


def build(folder: Path) -> Path:
    """Compile the program into *folder*, unless it is there; return its path.

    Raises:
        subprocess.CalledProcessError: the compiler failed; its own message is on stderr.
    """
    program = folder / _PROGRAM
    if not program.exists():
        constants = [f"-D{name}={value}" for name, value in _CONSTANTS.items()]
        command = [*_compiler(), "-O2", "-Wall", "-Werror", *constants]
        subprocess.run([*command, str(_SOURCE), "-o", str(program)], check=True)
    return program


def role(link: Cable, name: str, job: dict[str, Any], *, side: int, cpu: int) -> Process:
    """Return a role of a measurement at one end: ``c.MODE`` of the program, or of ``worker.py``."""
    module, _, mode = name.partition(".")
    if module == PREFIX:
        return raw_loop(link, mode, job, side=side, cpu=cpu)
    return link.worker(name, job, side=side, cpu=cpu)


@contextmanager
def raw_loop(
    link: Cable, mode: str, job: dict[str, Any], *, side: int, cpu: int
) -> Iterator[Worker]:
    """Run *mode* of the program at one end, pinned to one core, with the job of a raw role.

    Without ``frame`` in the job its frame is that of the raw loop in Python.
    """
    path = link.folder / f"frame-{side}"
    path.write_bytes(job.get("frame") or frame_octets(Shape(**job["shape"])))
    words = [mode, job["interface"], str(path), job["page"], str(job.get("seconds", 0))]
    program = [str(build(link.folder)), *words, str(job.get("batch", 1))]
    worker = Worker(link.command(side, "taskset", "-c", str(cpu), *program))
    try:
        yield worker
    finally:
        worker.close()


def _compiler() -> list[str]:
    return shlex.split(os.environ.get("CC", "cc"))
