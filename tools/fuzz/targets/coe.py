"""A CoE server given any requests, and clients given any answers; both are cut from the octets."""

from __future__ import annotations

from contextlib import suppress

from devicebus.errors import BusError, MailboxRefusedError
from devicebus.mailbox import coe_client
from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.mailbox import MailboxType
from eap.od.abort import SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.info import ListType
from eap.od.model import RW, OdState, array, variable
from tools.fuzz.messages import answer_with, cut

SIZES = MailboxSizes(40, 32)
_HEADS = (b"", b"\x00\x20", b"\x00\x30", b"\x00\x80")


def fuzz_one(data: bytes) -> None:
    """Serve and ask; only refusals, and errors of the bus, may pass."""
    messages = [_HEADS[len(octets) % 4] + octets for octets in cut(data)]
    dictionary = ObjectDictionary(
        [
            variable(0x1018, "Text", "STRING(60)", RW, "x" * 60),
            array(0x1C12, "Array", "UINT", range(20), RW),
        ]
    )
    server = CoeServer(dictionary, lambda: OdState.OP, SIZES)
    for message in messages:
        with suppress(MailboxRefusedError):
            for answer in server.receive_message(message, 0):
                if len(answer) > SIZES.data_to_master:
                    raise AssertionError(f"an answer of {len(answer)} octets")
    talks: list[Conversation[object]] = [
        coe_client.upload(0x1018, 0),
        coe_client.download(0x1018, 0, bytes(50), SIZES),
        coe_client.object_list(ListType.ALL),
        coe_client.object_description(0x1018),
        coe_client.entry_description(0x1018, 0),
    ]
    for talk in talks:
        with suppress(BusError, SdoAbortError):
            answer_with(talk, MailboxType.COE, messages)
