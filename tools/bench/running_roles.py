"""Commands that use the bus of a running plant until the benchmark ends them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

from devicebus.mailbox import foe_client
from devicebus.mailbox.coe_client import upload
from devicebus.mailbox.conversation import Conversation, Progress
from devicebus.mailbox.protocol import MailboxSizes
from eap.ops.bus_running import RunningBus, open_running
from eap.runtime.folder import VARIABLE
from tools.bench.buses import FILE
from tools.bench.network import Page
from tools.bench.pacing import answer


def read_objects(job: dict[str, Any]) -> None:
    """Read an object from each slave in turn; answer with how many."""
    words, count = Page(Path(job["page"])).words, 0
    with _open(job) as bus:
        slaves = bus.scan()
        answer({"slaves": len(slaves)})
        while not words[Page.STOP]:
            for slave in slaves:
                bus.converse(slave, lambda sizes: upload(0x1018, 1), "reading an object")
            count += len(slaves)
    answer({"reads": count})


def write_files(job: dict[str, Any]) -> None:
    """Write a file to the first slave again and again; answer with how many octets."""
    words, count = Page(Path(job["page"])).words, 0
    content = bytes(job["size"])
    with _open(job) as bus:
        first = bus.scan()[0]
        answer({"ready": True})
        while not words[Page.STOP]:
            progress = Progress()

            def write(sizes: MailboxSizes, progress: Progress = progress) -> Conversation[int]:
                source = BytesIO(content).read
                return foe_client.write(FILE, source, sizes, progress=progress)

            bus.converse(first, write, "writing a file")
            count += progress.done
    answer({"octets": count})


@contextmanager
def _open(job: dict[str, Any]) -> Iterator[RunningBus]:
    os.environ[VARIABLE] = job["runtime"]
    with open_running(job["station"], job["port"]) as bus:
        yield bus
