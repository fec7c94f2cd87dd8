"""SoE as conversations: reading, writing and describing IDNs of a drive (ETG.1000.6).

An answer is identified by drive and IDN.  Only the last fragment of an answer carries the IDN, so
fragments that end in another IDN are a late answer and are dropped.
"""

from __future__ import annotations

import msgspec

from devicebus.errors import BusError, MailboxProtocolError, MailboxTimeoutError, SoeError
from devicebus.mailbox.conversation import (
    Conversation,
    MailboxMessage,
    MailboxRequest,
    Progress,
    reading,
)
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.mailbox import MailboxType
from eap.codec.soe import (
    COMMAND_CLEAR,
    COMMAND_START,
    DATA_OVERHEAD,
    DataState,
    Element,
    Idn,
    SoeAttribute,
    SoeErrorCode,
    SoeHeader,
    SoeOpcode,
    SoeScalar,
    SoeValue,
    decode_list,
    decode_message,
    decode_scalar,
    decode_value,
    encode_fragments,
    encode_message,
    error_code_of,
    name_of,
)

MAX_SIZE = 0x80020
"""Limit for an answer in bytes: eight elements, each a list of maximum length."""
# Limit for dropped answers to other requests before a read fails.
_MAX_LATE = 16
# Bytes of a request in front of the IDN, which fragments do not carry.
_NAMELESS = 2
POLL_DELAY_NS = 10_000_000
EXECUTION_TIMEOUT_NS = 60_000_000_000


def read(
    idn: Idn,
    elements: int = Element.VALUE,
    *,
    drive: int = 0,
    progress: Progress | None = None,
    delay_ns: int = 0,
) -> Conversation[bytes]:
    """Read elements of an IDN, concatenated; lists and texts include their length header.

    Raises:
        SoeError: the drive refuses the request.
        MailboxProtocolError: the answer is invalid.
    """
    _, content = yield from _read(idn, elements, drive, progress, delay_ns)
    return content


def _read(
    idn: Idn, elements: int, drive: int, progress: Progress | None, delay_ns: int
) -> Conversation[tuple[MailboxMessage, bytes]]:
    """Read elements as read() does; return the last message as well."""
    what = f"SoE read of {idn} at drive {drive}"
    progress = progress or Progress()
    number = idn.number
    request = encode_message(SoeOpcode.READ_REQUEST, number, drive=drive, elements=elements)
    content = bytearray()
    left: int | None = None
    late = 0
    while True:
        if left is None and not late:
            message = yield MailboxRequest(MailboxType.SOE, request, delay_ns=delay_ns)
        else:
            # Fragments do not carry the IDN: they are matched by opcode and drive.
            listened = request if left is None else request[:_NAMELESS]
            message = yield MailboxRequest(MailboxType.SOE, listened, listen=True)
        with reading(what):
            header, body = decode_message(message.data)
        # While fragments follow, the IDN field holds the number of fragments left.
        is_foreign = not header.incomplete and header.idn != number
        now_left = header.idn if header.incomplete else 0
        # A growing count begins another answer: the fragments before it belong to a late one, which
        # a foreign IDN ends.
        if is_foreign or (left is not None and now_left > left):
            content.clear()
            late += 1
            if late > _MAX_LATE:
                raise MailboxProtocolError(f"{what}: {late} answers for other IDNs")
            if is_foreign:
                left = None
                continue
        elif header.error:
            raise _error_of(what, body)
        elif left is not None and now_left != left - 1:
            raise MailboxProtocolError(f"{what}: {left} fragments left, then {now_left}")
        content += body
        progress.done = len(content)
        if len(content) > MAX_SIZE:
            raise MailboxProtocolError(f"{what}: more than {MAX_SIZE} bytes")
        if not header.incomplete:
            return message, bytes(content)
        left = now_left


def write(
    idn: Idn,
    data: bytes,
    sizes: MailboxSizes,
    *,
    elements: int = Element.VALUE,
    drive: int = 0,
    progress: Progress | None = None,
) -> Conversation[None]:
    """Write an element of an IDN; a list includes its length header.

    Raises:
        SoeError: the drive refuses the request.
        MailboxProtocolError: the answer is invalid.
    """
    what = f"SoE write of {idn} at drive {drive}"
    progress = progress or Progress()
    progress.total = len(data)
    fragment_size = sizes.to_slave - DATA_OVERHEAD
    header = SoeHeader(SoeOpcode.WRITE_REQUEST, 0, 0, drive, elements, idn.number)
    *fragments, last = encode_fragments(header, data, fragment_size)
    # Only the last fragment of a write is answered; a full mailbox delays the next fragment.
    for fragment in fragments:
        yield MailboxRequest(MailboxType.SOE, fragment, expects_reply=False)
        progress.done += fragment_size
    message = yield MailboxRequest(MailboxType.SOE, last)
    with reading(what):
        answer, body = decode_message(message.data)
    if answer.error:
        raise _error_of(what, body)
    if answer.idn != idn.number or answer.incomplete:
        raise MailboxProtocolError(f"{what}: answered for {Idn.of(answer.idn)}")
    progress.done = len(data)


def execute(
    idn: Idn,
    sizes: MailboxSizes,
    *,
    drive: int = 0,
    timeout_ns: int = EXECUTION_TIMEOUT_NS,
) -> Conversation[None]:
    """Start a procedure command, wait for its end, and clear it.

    Raises:
        SoeError: the drive refuses, or the command fails.
        MailboxTimeoutError: the command still runs after *timeout_ns*.
        MailboxProtocolError: an answer is invalid.
    """
    what = f"procedure command {idn} at drive {drive}"
    yield from write(idn, COMMAND_START.to_bytes(2, "little"), sizes, drive=drive)
    state = DataState.BUSY
    since_ns: int | None = None
    # Limited by count as well: without a clock, the messages carry no time.
    for _ in range(max(1, timeout_ns // POLL_DELAY_NS)):
        message, octets = yield from _read(idn, Element.DATA_STATE, drive, None, POLL_DELAY_NS)
        if len(octets) < 2:
            raise MailboxProtocolError(f"{what}: a data state of {len(octets)} bytes")
        state = DataState(int.from_bytes(octets[:2], "little") & DataState.FAILED)
        if state & DataState.ERROR or not state & DataState.EXECUTING:
            break
        since_ns = message.at_ns if since_ns is None else since_ns
        if message.at_ns - since_ns > timeout_ns:
            break
    try:
        # Cleared in every case, or the drive refuses the next start (IEC 61800-7-300).
        yield from write(idn, COMMAND_CLEAR.to_bytes(2, "little"), sizes, drive=drive)
    except BusError:
        if not state & DataState.EXECUTING:
            raise  # otherwise the time-out is the more useful error
    if state & DataState.ERROR:
        raise SoeError(f"{what}: failed", code=SoeErrorCode.GENERAL)
    if state & DataState.EXECUTING:
        raise MailboxTimeoutError(f"{what}: not done after {timeout_ns / 1e9:g} s")


def _error_of(what: str, body: memoryview) -> SoeError:
    with reading(what):
        code = error_code_of(body)
    return SoeError(f"{what}: {name_of(code)} (0x{code:04X})", code=code)


LIST_OF_ALL = Idn.parse("S-0-0017")
_IDNS = SoeAttribute(length=1, is_list=1)


class IdnDescription(msgspec.Struct, frozen=True):
    """IDN with its elements; None for a missing element."""

    idn: Idn
    attribute: SoeAttribute
    value: SoeValue
    name: str | None = None
    unit: str | None = None
    minimum: SoeScalar | None = None
    maximum: SoeScalar | None = None
    default: SoeValue | None = None
    data_state: int | None = None
    """Element 1 of a procedure command; other IDNs usually have none."""


def idn_list(idn: Idn = LIST_OF_ALL, *, drive: int = 0) -> Conversation[list[Idn]]:
    """Read a list of IDNs, by default of all IDNs; raises as read() does."""
    octets = yield from read(idn, drive=drive)
    with reading(f"IDN list {idn}"):
        _, numbers = decode_list(octets)
        return [Idn.of(int(decode_scalar(_IDNS, numbers[at:]))) for at in range(0, len(numbers), 2)]


def describe(idn: Idn, *, drive: int = 0) -> Conversation[IdnDescription]:
    """Read all elements of an IDN, one at a time; raises as read() does.

    An element that the drive refuses is None; attribute and value are required.
    """
    octets = yield from read(idn, Element.ATTRIBUTE, drive=drive)
    with reading(f"attribute of {idn}"):
        attribute = SoeAttribute.decode(octets)
    value = yield from read(idn, drive=drive)
    name = yield from _read_if_any(idn, Element.NAME, drive)
    unit = yield from _read_if_any(idn, Element.UNIT, drive)
    minimum = yield from _read_if_any(idn, Element.MINIMUM, drive)
    maximum = yield from _read_if_any(idn, Element.MAXIMUM, drive)
    default = yield from _read_if_any(idn, Element.DEFAULT, drive)
    state = yield from _read_if_any(idn, Element.DATA_STATE, drive)
    with reading(f"elements of {idn}"):
        return IdnDescription(
            idn,
            attribute,
            decode_value(attribute, value),
            _text(name),
            _text(unit),
            None if minimum is None else decode_scalar(attribute, minimum),
            None if maximum is None else decode_scalar(attribute, maximum),
            None if default is None else decode_value(attribute, default),
            None if state is None else int.from_bytes(state, "little"),
        )


def _read_if_any(idn: Idn, element: Element, drive: int) -> Conversation[bytes | None]:
    try:
        # Each missing element has an error code of its own, such as 0x2001 for the name; a request
        # for several elements at once would fail as a whole.
        return (yield from read(idn, element, drive=drive))
    except SoeError:
        return None


def _text(octets: bytes | None) -> str | None:
    return None if octets is None else decode_list(octets)[1].rstrip(b"\0").decode(errors="replace")
