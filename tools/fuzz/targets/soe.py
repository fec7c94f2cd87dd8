"""An SoE server given any requests, and clients given any answers; both are cut from the octets."""

from __future__ import annotations

from contextlib import suppress

from devicebus.errors import BusError, MailboxRefusedError
from devicebus.mailbox import soe_client
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.soe_server import ProcedureCommand, SoeParameter, SoeServer
from eap.codec.mailbox import MailboxType
from eap.codec.soe import Display, Idn, SoeAttribute, decode_value
from eap.errors import CodecError
from eap.od.model import OdState
from tools.fuzz.messages import answer_with, cut

SIZES = MailboxSizes(24, 20)
MODE, LIST, RESET = map(Idn.parse, ("S-0-0000", "S-0-0001", "S-0-0002"))
_ATTRIBUTES = (
    SoeAttribute(),
    SoeAttribute(length=1, is_list=1, display=Display.IDN),
    SoeAttribute(length=1, is_command=1, display=Display.BINARY),
)


def fuzz_one(data: bytes) -> None:
    """Serve and ask; only refusals, and errors of the bus and of decoders, may pass."""
    messages = list(cut(data))
    parameters = [
        SoeParameter(str(MODE), "Mode", _ATTRIBUTES[0], 1, limits=(0, 9)),
        SoeParameter(str(LIST), "List", _ATTRIBUTES[1], range(30)),
        SoeParameter(
            str(RESET), "Reset", _ATTRIBUTES[2], procedure=ProcedureCommand(duration_ns=3)
        ),
    ]
    server = SoeServer({0: parameters, 1: parameters}, lambda: OdState.OP, SIZES)
    for now_ns, message in enumerate(messages):
        with suppress(MailboxRefusedError):
            for answer in server.receive_message(message, now_ns):
                if len(answer) > SIZES.data_to_master:
                    raise AssertionError(f"an answer of {len(answer)} octets")
        server.messages_to_send(now_ns)
    talks: list[Conversation[object]] = [
        soe_client.write(LIST, bytes(40), SIZES),
        soe_client.execute(RESET, SIZES, timeout_ns=100_000_000),
    ]
    for talk in talks:
        with suppress(BusError):
            answer_with(talk, MailboxType.SOE, messages)
    for attribute in _ATTRIBUTES:
        with suppress(BusError, CodecError):
            read = answer_with(soe_client.read(MODE), MailboxType.SOE, messages)
            decode_value(attribute, read)
