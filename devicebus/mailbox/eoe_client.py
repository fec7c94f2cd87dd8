"""EoE settings as conversations: the master's side of setting and reading IP (ETG.1000.6)."""

from __future__ import annotations

from devicebus.errors import EoeError
from devicebus.mailbox.conversation import Conversation, MailboxRequest, reading
from eap.codec.eoe import (
    EoeResult,
    EoeType,
    IpSettings,
    decode_message,
    encode_message,
    name_of,
)
from eap.codec.mailbox import MailboxType


def set_ip(settings: IpSettings, *, port: int = 0) -> Conversation[None]:
    """Give a slave Ethernet settings; those that are None stay as they are.

    Raises:
        EoeError: the slave refuses.
        MailboxProtocolError: its answer is no answer.
        CodecError: the name is too long.
    """
    request = encode_message(EoeType.SET_IP_REQUEST, settings.encode(), port=port)
    yield from _ask("EoE set IP", request)


def get_ip(*, port: int = 0) -> Conversation[IpSettings]:
    """Read a slave's Ethernet settings; raises as set_ip() does."""
    request = encode_message(EoeType.GET_IP_REQUEST, port=port)
    body = yield from _ask("EoE get IP", request)
    with reading("EoE get IP"):
        return IpSettings.decode(body)


def _ask(what: str, request: bytes) -> Conversation[bytes]:
    message = yield MailboxRequest(MailboxType.EOE, request)
    with reading(what):
        _, result, body = decode_message(message.data)
    if result != EoeResult.OK:
        raise EoeError(f"{what}: {name_of(result)} (0x{result:04X})", result=result)
    return bytes(body)
