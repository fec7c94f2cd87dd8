"""The product as the master of a simulated segment, through the session that ``eapctl bus`` has."""

from __future__ import annotations

from io import BytesIO
from time import perf_counter_ns
from typing import Any

from devicebus.mailbox import foe_client
from devicebus.mailbox.coe_client import upload
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.wire.alstatus import AlState
from eap.ids import InterfaceUri
from eap.ops.bus_session import open_bus
from tools.bench.buses import FILE
from tools.bench.pacing import answer


def acyclic(job: dict[str, Any]) -> None:
    """Scan, read an object, write a file; answer with the nanoseconds of each."""
    scans, reads, files = [], [], []
    with open_bus(InterfaceUri.parse(f"ethernet://{job['interface']}")) as session:
        for _ in range(job["scans"]):
            begin = perf_counter_ns()
            units = session.scan()
            scans.append(perf_counter_ns() - begin)
        session.bring(units, AlState.PREOP)
        first = units[0]
        for _ in range(job["reads"]):
            begin = perf_counter_ns()
            session.converse(first, lambda sizes: upload(0x1018, 1), "reading an object")
            reads.append(perf_counter_ns() - begin)
        content = bytes(job["size"])

        def write(sizes: MailboxSizes) -> Conversation[int]:
            return foe_client.write(FILE, BytesIO(content).read, sizes)

        for _ in range(job["files"]):
            begin = perf_counter_ns()
            session.converse(first, write, "writing a file")
            files.append(perf_counter_ns() - begin)
        session.bring(units, AlState.INIT)
    answer({"slaves": len(units), "scan": scans, "read": reads, "file": files})
