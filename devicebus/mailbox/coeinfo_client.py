"""SDO information and PDOs over the mailbox as conversations: the master's side (ETG.1000.6)."""

from __future__ import annotations

import struct

from devicebus.errors import MailboxProtocolError
from devicebus.mailbox.conversation import Conversation, MailboxRequest, reading
from devicebus.mailbox.match import INFO_START
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
from eap.ids import ObjectId
from eap.od.abort import SdoAbortError
from eap.od.info import ListType, ValueInfo

MAX_SIZE = 0x20002
"""Octets of the longest description: a list of all indexes there can be."""
_MAX_LATE = 16
"""Fragments of other answers that are dropped before a request gives up."""


def object_list(list_type: ListType = ListType.ALL) -> Conversation[list[int]]:
    """Read the indexes of a list, or the five counts of the others.

    Raises:
        SdoAbortError: the slave refuses.
        MailboxProtocolError: its answer is no answer.
    """
    body = yield from read_list(list_type)
    if len(body) % 2:
        what = f"object list {list_type.name}"
        raise MailboxProtocolError(f"{what}: {len(body)} octets, expected whole indexes")
    return list(struct.unpack(f"<{len(body) // 2}H", body))[1:]


def object_description(index: int) -> Conversation[ObjectDescription]:
    """Read what the slave says of an object; raises as object_list() does."""
    body = yield from read_object(index)
    with reading(f"object description 0x{index:04X}"):
        return ObjectDescription.decode(body)


def entry_description(
    index: int, subindex: int, value_info: int = ~ValueInfo(0)
) -> Conversation[EntryDescription]:
    """Read what the slave says of an entry; raises as object_list() does."""
    body = yield from read_entry(index, subindex, value_info)
    with reading(f"entry description {ObjectId(index, subindex)}"):
        return EntryDescription.decode(body)


def read_list(list_type: int) -> Conversation[bytes]:
    """As object_list(), but return the octets, list type included."""
    request = ListRequest(list_type).encode()
    return (yield from _ask(f"object list {list_type}", SdoInfoOpcode.LIST_REQUEST, request))


def read_object(index: int) -> Conversation[bytes]:
    """As object_description(), but return the octets."""
    what = f"object description 0x{index:04X}"
    request = ObjectRequest(index).encode()
    return (yield from _ask(what, SdoInfoOpcode.OBJECT_REQUEST, request, index=index))


def read_entry(index: int, subindex: int, value_info: int) -> Conversation[bytes]:
    """As entry_description(), but return the octets."""
    what = f"entry description {ObjectId(index, subindex)}"
    request = EntryRequest(index, subindex, value_info).encode()
    opcode = SdoInfoOpcode.ENTRY_REQUEST
    return (yield from _ask(what, opcode, request, index=index, subindex=subindex))


def read(opcode: SdoInfoOpcode, request: bytes) -> Conversation[bytes]:
    """Send any request; return the octets of the answer.  Raises as object_list() does."""
    index = 0 if opcode is SdoInfoOpcode.LIST_REQUEST else int.from_bytes(request[:2], "little")
    subindex = int.from_bytes(request[2:3], "little")
    what = f"SDO information {opcode.name} {ObjectId(index, subindex)}"
    return (yield from _ask(what, opcode, request, index=index, subindex=subindex))


def read_pdo(service: CoeService, number: int) -> Conversation[bytes]:
    """Ask for a PDO through the mailbox; *service* is TX_PDO or RX_PDO."""
    remote = {
        CoeService.TX_PDO: CoeService.TX_PDO_REMOTE_REQUEST,
        CoeService.RX_PDO: CoeService.RX_PDO_REMOTE_REQUEST,
    }[service]
    request = encode_message(remote, b"", number=number)
    message = yield MailboxRequest(MailboxType.COE, request)
    return message.data[CoeHeader.SIZE :]


def write_rx_pdo(number: int, data: bytes) -> Conversation[None]:
    """Send an RxPDO through the mailbox; nothing confirms it."""
    request = encode_message(CoeService.RX_PDO, data, number=number)
    yield MailboxRequest(MailboxType.COE, request, expects_reply=False)


def _ask(
    what: str,
    opcode: SdoInfoOpcode,
    request: bytes,
    *,
    index: int = 0,
    subindex: int = 0,
) -> Conversation[bytes]:
    """Send a request; return the bodies of all fragments of the answer."""
    sent = encode_message(CoeService.SDO_INFORMATION, SdoInfoHeader(opcode).encode() + request)
    body = b""
    left: int | None = None
    late = 0
    while left != 0:
        if left is None:
            message = yield MailboxRequest(MailboxType.COE, sent)
        else:
            message = yield MailboxRequest(MailboxType.COE, sent[:INFO_START], listen=True)
        with reading(what):
            header = SdoInfoHeader.decode(message.data, CoeHeader.SIZE)
            if header.opcode is SdoInfoOpcode.ERROR:
                code = InfoError.decode(message.data, INFO_START).abort_code
                raise SdoAbortError(code, index, subindex)
        if left is not None and header.fragments_left >= left and late < _MAX_LATE:
            late += 1
            continue
        if left is not None and header.fragments_left != left - 1:
            raise MailboxProtocolError(
                f"{what}: {left} fragments left, then {header.fragments_left}"
            )
        left = header.fragments_left
        body += message.data[INFO_START:]
        if len(body) > MAX_SIZE:
            raise MailboxProtocolError(f"{what}: more than {MAX_SIZE} octets")
    return body
