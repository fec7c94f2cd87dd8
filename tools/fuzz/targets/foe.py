"""An FoE server given any requests, and clients given any answers; both are cut from the octets."""

from __future__ import annotations

from contextlib import suppress

from devicebus.errors import BusError, MailboxRefusedError
from devicebus.mailbox import foe_client
from devicebus.mailbox.foe_server import FoeServer, MemoryFile, MemoryStore
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.mailbox import MailboxType
from tools.fuzz.messages import answer_with, cut

SIZES = MailboxSizes(24, 20)


def fuzz_one(data: bytes) -> None:
    """Serve and ask; only refusals, and errors of the bus, may pass."""
    messages = [bytes((len(octets) % 8, 0)) + octets for octets in cut(data)]
    store = MemoryStore([MemoryFile("", bytes(30), max_size=50)], creates=True)
    server = FoeServer(store, SIZES, packet_time_ns=3)
    for now_ns, message in enumerate(messages):
        with suppress(MailboxRefusedError):
            for answer in server.receive_message(message, now_ns):
                if len(answer) > SIZES.data_to_master:
                    raise AssertionError(f"an answer of {len(answer)} octets")
    read = bytearray()
    with suppress(BusError):
        size = answer_with(foe_client.read("", read.extend, SIZES), MailboxType.FOE, messages)
        if size != len(read):
            raise AssertionError(f"{size} octets, the sink has {len(read)}")
    source = iter([b"ab", b"cdefghijkl", b"m"])
    with suppress(BusError):
        talk = foe_client.write("", lambda size: next(source, b"")[:size], SIZES)
        answer_with(talk, MailboxType.FOE, messages)
