"""CoE as conversations: SDO transfers, SDO information and PDOs of a slave (ETG.1000.6).

An answer is identified by index and subindex, a segment by its toggle bit.  An SDO abort of the
slave is raised as SdoAbortError.  After an invalid answer the slave gets an abort and
MailboxProtocolError is raised.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import NamedTuple, NoReturn

from devicebus.errors import MailboxProtocolError
from devicebus.mailbox.conversation import (
    INFO_START,
    Conversation,
    MailboxRequest,
    Progress,
    reading,
)
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.coe import (
    EXPEDITED_SIZE,
    INITIATE_OVERHEAD,
    SEGMENT_MINIMUM,
    SEGMENT_OVERHEAD,
    CoeHeader,
    CoeService,
    EntryDescription,
    EntryRequest,
    InfoError,
    ListRequest,
    ObjectDescription,
    ObjectRequest,
    SdoHeader,
    SdoInfoHeader,
    SdoInfoOpcode,
    SdoRequest,
    SdoResponse,
    SdoSegmentHeader,
    decode_segment,
    encode_abort,
    encode_initiate,
    encode_message,
    encode_plain,
    encode_segment,
    encode_segment_answer,
)
from eap.codec.mailbox import MailboxType
from eap.ids import ObjectId
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.info import ListType, ValueInfo

MAX_SIZE = 1 << 24
"""Default limit for the size of an uploaded object, in bytes."""
# A slave that sends more never ends a transfer.
MAX_SHORT = 1_000
"""Limit for segments of less than seven bytes."""


class UploadStart(NamedTuple):
    """First answer of an upload: size of the object, and the data of the first message."""

    size: int
    data: bytes


def upload(
    index: int,
    subindex: int,
    *,
    complete: bool = False,
    progress: Progress | None = None,
    max_size: int = MAX_SIZE,
) -> Conversation[bytes]:
    """Read an entry, or with *complete* a whole object from subindex 0 or 1 on.

    Raises:
        SdoAbortError: the slave aborts the transfer.
        MailboxProtocolError: the answer is invalid, or longer than *max_size*.
    """
    start = yield from begin_upload(index, subindex, complete=complete, max_size=max_size)
    return (yield from continue_upload(index, subindex, start, progress=progress))


def begin_upload(
    index: int, subindex: int, *, complete: bool = False, max_size: int = MAX_SIZE
) -> Conversation[UploadStart]:
    """Run the first step of upload(); raises as upload() does."""
    sdo = _Sdo(index, subindex)
    plain = encode_plain(SdoRequest.UPLOAD, index, subindex, complete=complete)
    head, rest = yield from sdo.exchange(plain)
    if head.expedited:
        return UploadStart(len(head.data), head.data)
    size = head.value
    if size > max_size:
        yield from sdo.abort(
            AbortCode.OUT_OF_MEMORY, f"{size} bytes, at most {max_size} are accepted"
        )
    return UploadStart(size, rest[:size])


def continue_upload(
    index: int,
    subindex: int,
    start: UploadStart,
    *,
    progress: Progress | None = None,
    sink: Callable[[bytes], object] | None = None,
) -> Conversation[bytes]:
    """Run the remaining steps of upload(); *sink* receives each segment's data."""
    sdo, size = _Sdo(index, subindex), start.size
    content = bytearray(start.data)
    progress = progress or Progress()
    progress.done, progress.total = len(content), size
    # The first segment has toggle bit 0; the initiate message has no toggle bit.
    toggle = short = 0
    # The end is decided by the size of the first answer, not by the last bit: a slave that sets it
    # too early or too late breaks the protocol.
    while len(content) < size:
        request = encode_segment_answer(SdoRequest.UPLOAD_SEGMENT, toggle=toggle)
        body = yield from sdo.exchange_segment(request)
        with reading("segment of", sdo):
            segment, data = decode_segment(body)
        content += data
        if len(content) > size:
            yield from sdo.abort(AbortCode.TOO_LONG, f"more than the {size} bytes announced")
        # No abort here: with the last bit the slave has ended the transfer itself.
        if segment.last and len(content) < size:
            raise MailboxProtocolError(f"{sdo}: {len(content)} bytes of {size} announced")
        short += len(data) < SEGMENT_MINIMUM
        # Without a limit a slave with empty or tiny segments would hold its mailbox for ever.
        if not data or short > MAX_SHORT:
            reason = f"{short} short segments" if data else "a segment without data"
            yield from sdo.abort(AbortCode.GENERAL, reason)
        progress.done = len(content)
        if sink is not None:
            sink(data)
        toggle ^= 1
    return bytes(content)


def download(
    index: int,
    subindex: int,
    data: bytes,
    sizes: MailboxSizes,
    *,
    complete: bool = False,
    progress: Progress | None = None,
) -> Conversation[None]:
    """Write an entry, or with *complete* a whole object from subindex 0 or 1 on.

    Raises:
        SdoAbortError: the slave refuses.
        MailboxProtocolError: its answer is no answer.
    """
    sdo = _Sdo(index, subindex)
    progress = progress or Progress()
    progress.total = len(data)
    # Unlike in CANopen, the first message of a normal download already carries data.
    data_size = sizes.to_slave - INITIATE_OVERHEAD
    first = encode_initiate(
        SdoRequest.DOWNLOAD, index, subindex, data, complete=complete, max_size=data_size
    )
    yield from sdo.exchange(first)
    progress.done = len(data) if len(data) <= EXPEDITED_SIZE else min(data_size, len(data))
    step = sizes.to_slave - SEGMENT_OVERHEAD
    toggle = 0
    while progress.done < len(data):
        piece = data[progress.done : progress.done + step]
        last = progress.done + len(piece) == len(data)
        segment = encode_segment(SdoRequest.DOWNLOAD_SEGMENT, piece, toggle=toggle, last=last)
        yield from sdo.exchange_segment(segment)
        progress.done += len(piece)
        toggle ^= 1


def download_unsized(index: int, subindex: int, octets: bytes) -> Conversation[None]:
    """Write an entry from four bytes, cut to the size of the entry.  Raises as download()."""
    # Expedited without the size bit (command byte 0x22): the entry determines the size.
    value = int.from_bytes(octets, "little")
    head = SdoHeader(0, 1, 0, 0, SdoRequest.DOWNLOAD, index, subindex, value)
    yield from _Sdo(index, subindex).exchange(head.encode())


class _Sdo:
    """One SDO transfer: its requests, and the check of its answers."""

    def __init__(self, index: int, subindex: int) -> None:
        self.index = index
        self.subindex = subindex

    def __str__(self) -> str:
        return f"SDO {ObjectId(self.index, self.subindex)}"

    def exchange(self, body: bytes) -> Conversation[tuple[SdoHeader, bytes]]:
        """Send the first message of a transfer; return head and data of the answer."""
        request = encode_message(CoeService.SDO_REQUEST, body)
        data = (yield MailboxRequest(MailboxType.COE, request)).data
        with reading("answer to", self):
            head = SdoHeader.decode(data, CoeHeader.SIZE)
        # Either side may abort; the abort of a slave comes as an SDO request (CoE service 2) too.
        if head.specifier == SdoResponse.ABORT:
            raise SdoAbortError(head.value, self.index, self.subindex)
        return head, data[CoeHeader.SIZE + SdoHeader.SIZE :]

    def exchange_segment(self, body: bytes) -> Conversation[bytes]:
        """Send a segment or a segment request; return the answer without its CoE header."""
        request = encode_message(CoeService.SDO_REQUEST, body)
        data = (yield MailboxRequest(MailboxType.COE, request)).data
        with reading("segment of", self):
            head = SdoSegmentHeader.decode(data, CoeHeader.SIZE)
            if head.specifier == SdoResponse.ABORT:
                code = SdoHeader.decode(data, CoeHeader.SIZE).value
                raise SdoAbortError(code, self.index, self.subindex)
        return data[CoeHeader.SIZE :]

    def abort(self, code: AbortCode, reason: str) -> Conversation[NoReturn]:
        """Abort the transfer and raise."""
        abort = encode_abort(self.index, self.subindex, code)
        # An abort is never answered (ETG.1000.6): nothing is awaited.
        yield MailboxRequest(MailboxType.COE, abort, expects_reply=False)
        raise MailboxProtocolError(f"{self}: {reason}")


MAX_INFO_SIZE = 0x20002
"""Limit for a description in bytes: a list of all 65,536 indexes."""
# Limit for dropped fragments of other answers before a request fails.
_MAX_LATE = 16


def object_list(list_type: ListType = ListType.ALL) -> Conversation[list[int]]:
    """Read the indexes of a list, or the five counts of the others.

    Raises:
        SdoAbortError: the slave refuses.
        MailboxProtocolError: its answer is no answer.
    """
    body = yield from read_list(list_type)
    if len(body) % 2:
        what = f"object list {list_type.name}"
        raise MailboxProtocolError(f"{what}: {len(body)} bytes, expected whole indexes")
    # The first word of the answer is the list type.
    return list(struct.unpack(f"<{len(body) // 2}H", body))[1:]


def object_description(index: int) -> Conversation[ObjectDescription]:
    """Read the description of an object; raises as object_list() does."""
    body = yield from read_object(index)
    with reading(f"object description 0x{index:04X}"):
        return ObjectDescription.decode(body)


def entry_description(
    index: int, subindex: int, value_info: int = ~ValueInfo(0)
) -> Conversation[EntryDescription]:
    """Read the description of an entry; raises as object_list() does."""
    body = yield from read_entry(index, subindex, value_info)
    with reading(f"entry description {ObjectId(index, subindex)}"):
        return EntryDescription.decode(body)


def read_list(list_type: int) -> Conversation[bytes]:
    """Return the encoded answer of object_list(), list type included."""
    request = ListRequest(list_type).encode()
    return (yield from _ask(f"object list {list_type}", SdoInfoOpcode.LIST_REQUEST, request))


def read_object(index: int) -> Conversation[bytes]:
    """Return the encoded answer of object_description()."""
    what = f"object description 0x{index:04X}"
    request = ObjectRequest(index).encode()
    return (yield from _ask(what, SdoInfoOpcode.OBJECT_REQUEST, request, index=index))


def read_entry(index: int, subindex: int, value_info: int) -> Conversation[bytes]:
    """Return the encoded answer of entry_description()."""
    what = f"entry description {ObjectId(index, subindex)}"
    request = EntryRequest(index, subindex, value_info).encode()
    opcode = SdoInfoOpcode.ENTRY_REQUEST
    return (yield from _ask(what, opcode, request, index=index, subindex=subindex))


def read(opcode: SdoInfoOpcode, request: bytes) -> Conversation[bytes]:
    """Send an SDO information request; return its encoded answer.  Raises as object_list()."""
    index = 0 if opcode is SdoInfoOpcode.LIST_REQUEST else int.from_bytes(request[:2], "little")
    subindex = int.from_bytes(request[2:3], "little")
    what = f"SDO information {opcode.name} {ObjectId(index, subindex)}"
    return (yield from _ask(what, opcode, request, index=index, subindex=subindex))


def read_pdo(service: CoeService, number: int) -> Conversation[bytes]:
    """Read a PDO through the mailbox; *service* is TX_PDO or RX_PDO."""
    remote = {
        CoeService.TX_PDO: CoeService.TX_PDO_REMOTE_REQUEST,
        CoeService.RX_PDO: CoeService.RX_PDO_REMOTE_REQUEST,
    }[service]
    request = encode_message(remote, b"", number=number)
    message = yield MailboxRequest(MailboxType.COE, request)
    return message.data[CoeHeader.SIZE :]


def write_rx_pdo(number: int, data: bytes) -> Conversation[None]:
    """Send an RxPDO through the mailbox, which has no confirmation."""
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
    """Send a request; return the joined bodies of the answer's fragments."""
    sent = encode_message(CoeService.SDO_INFORMATION, SdoInfoHeader(opcode).encode() + request)
    body = b""
    left: int | None = None
    late = 0
    while left != 0:
        if left is None:
            message = yield MailboxRequest(MailboxType.COE, sent)
        else:
            # Later fragments repeat the headers only, neither list type nor index.
            message = yield MailboxRequest(MailboxType.COE, sent[:INFO_START], listen=True)
        with reading(what):
            header = SdoInfoHeader.decode(message.data, CoeHeader.SIZE)
            if header.opcode is SdoInfoOpcode.ERROR:
                code = InfoError.decode(message.data, INFO_START).abort_code
                raise SdoAbortError(code, index, subindex)
        # A count that does not fall belongs to an answer whose request has timed out.
        if left is not None and header.fragments_left >= left and late < _MAX_LATE:
            late += 1
            continue
        if left is not None and header.fragments_left != left - 1:
            raise MailboxProtocolError(
                f"{what}: {left} fragments left, then {header.fragments_left}"
            )
        left = header.fragments_left
        body += message.data[INFO_START:]
        if len(body) > MAX_INFO_SIZE:
            raise MailboxProtocolError(f"{what}: more than {MAX_INFO_SIZE} bytes")
    return body
