"""A client of a gateway that is told anything, in every protocol, cut from the octets."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from devicebus.errors import BusError
from devicebus.mailbox import (
    coe_client,
    coeinfo_client,
    eoe_client,
    foe_client,
    soe_browse,
    soe_client,
    voe_client,
)
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.mailbox import MailboxHeader, MailboxType, encode_frame
from eap.codec.soe import Idn
from eap.errors import EapError
from eap.gateway.dialogue import Dialogue
from eap.gateway.slaves import read_slaves
from tools.fuzz.messages import cut

_SIZES = MailboxSizes(32, 32)
_MODE = Idn.of(32)
_MAX_STEPS = 200


def _talks() -> list[tuple[MailboxType, Conversation[Any]]]:
    return [
        (MailboxType.COE, coe_client.upload(0x1018, 1)),
        (MailboxType.COE, coe_client.download(0x2000, 0, bytes(60), _SIZES)),
        (MailboxType.COE, coeinfo_client.object_list()),
        (MailboxType.COE, read_slaves()),
        (MailboxType.SOE, soe_browse.describe(_MODE)),
        (MailboxType.SOE, soe_client.write(_MODE, bytes(50), _SIZES)),
        (MailboxType.FOE, foe_client.read("f", lambda data: None, _SIZES)),
        (MailboxType.VOE, voe_client.exchange(1, 2, b"a")),
        (MailboxType.EOE, eoe_client.get_ip()),
    ]


def fuzz_one(data: bytes) -> None:
    """Lead conversations; each ends with a result or a documented error."""
    messages = list(cut(data))
    for kind, talk in _talks():
        dialogue = Dialogue(talk, 1001)
        dialogue.receive(data)
        _lead(dialogue, kind, messages)
        with suppress(EapError, BusError):
            dialogue.result()


def _lead(dialogue: Dialogue[Any], kind: MailboxType, messages: list[bytes]) -> None:
    """Go through all messages, then let the time run out."""
    rest = iter(messages)
    for _ in range(_MAX_STEPS):
        if dialogue.is_done:
            return
        if not dialogue.expects_reply:
            dialogue.sent()
            continue
        body = next(rest, None)
        if body is None:
            dialogue.expire("")
        else:
            told = MailboxType.ERR if len(body) == 4 else kind
            dialogue.receive(encode_frame(MailboxHeader(0, 1001, type=told), body))
    raise AssertionError("a conversation without an end")
