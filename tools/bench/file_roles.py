"""A client that stores a file at a slave by pyads and fetches it again, as a process."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from time import perf_counter
from typing import Any

from tools.bench.pacing import answer, wait

SLAVE = 1001
BLOCK = 64_000
OPEN_READ, OPEN_WRITE, CLOSE, READ, WRITE = range(0xF401, 0xF406)
NAME = "firmware.bin"
_NOT_YET = frozenset((0x1B, 0x708))
"""A hop that was not found yet, a transfer that goes on."""
_PAUSE_S = 0.01


def transfer(job: dict[str, Any]) -> None:
    """Store a file and fetch it; tell how many seconds each took."""
    import pyads

    content = os.urandom(job["size"])
    with pyads.Connection(job["net_id"], SLAVE, job["address"]) as slave:

        def patiently(ask: Callable[..., Any], *what: Any, **how: Any) -> Any:
            while True:
                try:
                    return ask(*what, **how)
                except pyads.ADSError as refusal:
                    if refusal.err_code not in _NOT_YET:
                        raise
                wait(_PAUSE_S)

        def begin(group: int) -> Any:
            return patiently(
                slave.read_write, group, 0, pyads.PLCTYPE_UDINT, NAME, pyads.PLCTYPE_STRING
            )

        patiently(slave.read_state)
        start_s = perf_counter()
        handle = begin(OPEN_WRITE)
        for at in range(0, len(content), BLOCK):
            piece = content[at : at + BLOCK]
            patiently(slave.write, WRITE, handle, piece, ctypes.c_ubyte * len(piece))
        patiently(slave.write, CLOSE, handle, None, None)
        stored_s = perf_counter()
        handle = begin(OPEN_READ)
        back = b""
        while len(back) < len(content):
            octets = ctypes.c_ubyte * min(BLOCK, len(content) - len(back))
            back += bytes(patiently(slave.read, READ, handle, octets))
        patiently(slave.write, CLOSE, handle, None, None)
        fetched_s = perf_counter()
    if back != content:
        raise RuntimeError("the file came back as another one")
    answer({"stored": stored_s - start_s, "fetched": fetched_s - stored_s})
