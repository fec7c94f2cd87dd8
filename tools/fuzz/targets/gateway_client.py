"""Client of a gateway that receives anything, in every protocol, cut from the octets."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from typing import Any

from devicebus.errors import BusError
from devicebus.mailbox import coe_client, eoe, foe_client, soe_client, voe
from devicebus.mailbox.conversation import Conversation, MailboxMessage, MailboxRequest, drive
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.mailbox import MailboxHeader, MailboxType, encode_frame
from eap.codec.soe import Idn
from eap.errors import EapError
from eap.gateway.conversations import GatewayConversation, GatewayConversations
from eap.gateway.slaves import read_slaves
from tools.fuzz.messages import cut

_SIZES = MailboxSizes(32, 32)
_MODE = Idn.of(32)
_MAX_STEPS = 20_000


def _talks() -> list[tuple[MailboxType, Conversation[Any]]]:
    return [
        (MailboxType.COE, coe_client.upload(0x1018, 1)),
        (MailboxType.COE, coe_client.download(0x2000, 0, bytes(60), _SIZES)),
        (MailboxType.COE, coe_client.object_list()),
        (MailboxType.COE, read_slaves()),
        (MailboxType.SOE, soe_client.describe(_MODE)),
        (MailboxType.SOE, soe_client.write(_MODE, bytes(50), _SIZES)),
        (MailboxType.FOE, foe_client.read("f", lambda data: None, _SIZES)),
        (MailboxType.VOE, voe.exchange(1, 2, b"a")),
        (MailboxType.EOE, eoe.get_ip()),
    ]


def fuzz_one(data: bytes) -> None:
    """Run conversations; each ends with a result or a documented error."""
    messages = list(cut(data))
    for kind, talk in _talks():
        core = GatewayConversations(timeout_ns=1, tries=2, silence="")
        core.receive_frame(data, 0)
        exchange = partial(_exchange, core, GatewayConversation(1001), kind, iter(messages))
        with suppress(EapError, BusError):
            drive(talk, exchange)


def _exchange(
    core: GatewayConversations,
    place: GatewayConversation,
    kind: MailboxType,
    bodies: Iterator[bytes],
    handle: MailboxRequest,
) -> MailboxMessage:
    """Answer a request with one message after the other; then let the time run out."""
    now_ns = 0
    request = core.request(place, handle, now_ns)
    for _ in range(_MAX_STEPS):
        if request.is_done:
            return request.result()
        body = next(bodies, None)
        if body is None:
            now_ns = core.next_timeout() or 0
            core.handle_timeout(now_ns)
        else:
            received = MailboxType.ERR if len(body) == 4 else kind
            frame = encode_frame(MailboxHeader(0, 1001, type=received), body)
            core.receive_frame(frame, now_ns)
        core.frames_to_send(now_ns)
    raise AssertionError("a request without a result")
