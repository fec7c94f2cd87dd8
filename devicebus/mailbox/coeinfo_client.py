"""SDO information and PDOs over the mailbox as conversations: the master's side (ETG.1000.6)."""

from __future__ import annotations

import struct

from devicebus.errors import MailboxProtocolError
from devicebus.mailbox.conversation import Ask, Conversation, reading
from eap.codec.coe import CoeHeader, CoeService, encode_message
from eap.codec.mailbox import MailboxType
from eap.codec.sdoinfo import (
    EntryDescription,
    EntryRequest,
    InfoError,
    ListRequest,
    ObjectDescription,
    ObjectRequest,
    SdoInfoHeader,
    SdoInfoOpcode,
)
from eap.od.abort import SdoAbortError
from eap.od.info import ListType, ValueInfo

MAX_SIZE = 0x20002
"""Octets of the longest description: a list of all indexes there can be."""
_START = CoeHeader.SIZE + SdoInfoHeader.SIZE


def object_list(list_type: ListType = ListType.ALL) -> Conversation[list[int]]:
    """Read the indexes of a list, or the five counts of the others.

    Raises:
        SdoAbortError: the slave refuses.
        MailboxProtocolError: its answer is no answer.
    """
    what = f"object list {list_type.name}"
    request = ListRequest(list_type).encode()
    body = yield from _ask(what, SdoInfoOpcode.LIST_REQUEST, request, key_size=2)
    if len(body) % 2:
        raise MailboxProtocolError(f"{what}: {len(body)} octets, expected whole indexes")
    return list(struct.unpack(f"<{len(body) // 2}H", body))[1:]


def object_description(index: int) -> Conversation[ObjectDescription]:
    """Read what the slave says of an object; raises as object_list() does."""
    what = f"object description 0x{index:04X}"
    request = ObjectRequest(index).encode()
    body = yield from _ask(what, SdoInfoOpcode.OBJECT_REQUEST, request, key_size=2, index=index)
    with reading(what):
        return ObjectDescription.decode(body)


def entry_description(
    index: int, subindex: int, value_info: int = ~ValueInfo(0)
) -> Conversation[EntryDescription]:
    """Read what the slave says of an entry; raises as object_list() does."""
    what = f"entry description 0x{index:04X}:{subindex:02X}"
    request = EntryRequest(index, subindex, value_info).encode()
    body = yield from _ask(
        what, SdoInfoOpcode.ENTRY_REQUEST, request, key_size=3, index=index, subindex=subindex
    )
    with reading(what):
        return EntryDescription.decode(body)


def read_pdo(service: CoeService, number: int) -> Conversation[bytes]:
    """Ask for a PDO through the mailbox; *service* is TX_PDO or RX_PDO."""
    remote = {
        CoeService.TX_PDO: CoeService.TX_PDO_REMOTE_REQUEST,
        CoeService.RX_PDO: CoeService.RX_PDO_REMOTE_REQUEST,
    }[service]
    key = CoeHeader(number, service=service).encode()
    request = encode_message(remote, b"", number=number)
    message = yield Ask(MailboxType.COE, request, lambda data: data.startswith(key))
    return message.data[CoeHeader.SIZE :]


def write_rx_pdo(number: int, data: bytes) -> Conversation[None]:
    """Send an RxPDO through the mailbox; nothing confirms it."""
    request = encode_message(CoeService.RX_PDO, data, number=number)
    yield Ask(MailboxType.COE, request, expects_reply=False)


def _ask(
    what: str,
    opcode: SdoInfoOpcode,
    request: bytes,
    *,
    key_size: int,
    index: int = 0,
    subindex: int = 0,
) -> Conversation[bytes]:
    """Send a request; return the bodies of all fragments of the answer.

    The first *key_size* octets of the body are those of the request.
    """
    answer = SdoInfoOpcode(opcode + 1)
    key = request[:key_size]
    sent = encode_message(CoeService.SDO_INFORMATION, SdoInfoHeader(opcode).encode() + request)
    body = b""
    left: int | None = None
    while left != 0:
        expected = left

        def accepts(data: bytes, expected: int | None = expected) -> bool:
            if len(data) < 2 or data[1] >> 4 != CoeService.SDO_INFORMATION:
                return False
            found = data[2] & 0x7F if len(data) >= _START else SdoInfoOpcode.ERROR
            if found != answer:
                return found == SdoInfoOpcode.ERROR
            if expected is None:
                return data.startswith(key, _START)
            return int.from_bytes(data[4:6], "little") < expected

        message = yield Ask(MailboxType.COE, sent if left is None else None, accepts)
        with reading(what):
            header = SdoInfoHeader.decode(message.data, CoeHeader.SIZE)
            if header.opcode is SdoInfoOpcode.ERROR:
                code = InfoError.decode(message.data, _START).abort_code
                raise SdoAbortError(code, index, subindex)
        if left is not None and header.fragments_left != left - 1:
            raise MailboxProtocolError(
                f"{what}: {left} fragments left, then {header.fragments_left}"
            )
        left = header.fragments_left
        body += message.data[_START:]
        if len(body) > MAX_SIZE:
            raise MailboxProtocolError(f"{what}: more than {MAX_SIZE} octets")
    return body
