"""A bridge to a file: it writes each change as a line, and reads writes from another file.

Runs as a process of the supervisor, or by hand with :func:`start_bridge`.
"""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec

from eap.bridges.bridge import Bridge
from eap.bridges.process import run_bridge
from eap.errors import EapError, EnvironmentalError
from eap.runtime.handover import BridgeHandover
from eap.runtime.startup import Startup

PERIOD_MS = 20


class FileBridgeSection(msgspec.Struct):
    """Its section: files of values out and of writes in, and the selected variables."""

    out: str
    requests: str
    of: list[str]


def taken(file: Path) -> dict[str, Any]:
    """Return the requests of a file, and remove it."""
    try:
        requests: dict[str, Any] = json.loads(file.read_text())
    except FileNotFoundError:
        return {}
    file.unlink()
    return requests


async def serve(bridge: Bridge, section: FileBridgeSection) -> None:
    try:
        out = Path(section.out).open("w")  # noqa: ASYNC230, SIM115
    except OSError as exc:
        raise EnvironmentalError(f"{section.out}: {exc.strerror}") from None

    def write(line: object) -> None:
        print(json.dumps(line), file=out, flush=True)

    def take(values):
        bridge.status.sent += len(values)
        write({name: [each.value, each.quality, each.time_ns] for name, each in values.items()})

    feed = bridge.feed(section.of, PERIOD_MS, on_values=take,
                       on_variables=lambda: write(sorted(feed.variables)))  # fmt: skip
    bridge.ready()
    bridge.connected(f"file://{section.out}")
    try:
        async with asyncio.TaskGroup() as group:
            group.create_task(feed.run())
            while True:
                await asyncio.sleep(PERIOD_MS / 1000)
                for name, value in taken(Path(section.requests)).items():
                    try:
                        await bridge.write(name, value, transport="s7", host="10.9.9.9")
                    except EapError as exc:
                        write(str(exc))
    finally:
        write("ended")
        out.close()


def main(descriptor: int, startup: Startup) -> int:
    return run_bridge(descriptor, startup, FileBridgeSection, serve)


def start_bridge(
    folder: Path, name: str, section: FileBridgeSection, *, parent: int = 0
) -> tuple[subprocess.Popen[str], int]:
    """Start it beside the appliance in *folder*; return it, and where its start is reported."""
    raw = msgspec.Raw(msgspec.json.encode(section))
    handover = BridgeHandover(parent or os.getpid(), str(folder), "plant", name, raw)
    descriptor = handover.to_descriptor()
    report, report_end = os.pipe()
    words = ["eap.runtime.startup", __name__, str(descriptor), str(report_end), ""]
    process = subprocess.Popen(
        [sys.executable, "-m", *words], pass_fds=(descriptor, report_end),
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    os.close(descriptor)
    os.close(report_end)
    return process, report
