"""Decoded frames as records.

Malformed bytes raise nothing: the record has the fields before the fault, and ``error`` names it.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec import UNSET, Struct, UnsetType

from devicebus.wire.datagram import iter_datagrams
from eap.codec import ams, mailbox
from eap.codec.coe import describe_message
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.mailbox import MailboxError, MailboxErrorReply, MailboxHeader, MailboxType
from eap.codec.pd import PD_FRAME_START, PdFrameHeader, PdHeader, follow_pds, iter_pds
from eap.codec.wire import Buffer
from eap.errors import CodecError
from eap.pd.rhythm import CycleOrder, CycleWatch


class DecodedPd(Struct, frozen=True):
    """PD of a frame of type 4; *quality* in units of 100 us."""

    id: int
    version: int
    length: int
    quality: int
    data: str


class DecodedDatagram(Struct, frozen=True, kw_only=True):
    """Datagram of a frame of type 1: with ADP and ADO, or with a logical address."""

    command: str
    index: int
    adp: int | UnsetType = UNSET
    ado: int | UnsetType = UNSET
    address: int | UnsetType = UNSET
    length: int
    circulating: bool
    irq: int
    data: str
    wkc: int


class DecodedAms(Struct, frozen=True, kw_only=True):
    """AMS packet of a frame of type 2, or of a mailbox message."""

    target: str
    target_port: int
    source: str
    source_port: int
    command: int
    service: str
    state_flags: int
    length: int
    error_code: int
    invoke_id: int
    data: str


class DecodedMailbox(Struct, kw_only=True):
    """Mailbox message of a frame of type 5.

    *service* names a message of CoE, with the number of its PDO; *detail* and *reason* are those of
    an error reply.
    """

    length: int
    address: int
    channel: int
    priority: int
    type: int
    protocol: str
    counter: int
    data: str = ""
    service: str | UnsetType = UNSET
    ams: DecodedAms | UnsetType = UNSET
    detail: int | UnsetType = UNSET
    reason: str | UnsetType = UNSET


class DecodedFrame(Struct, kw_only=True):
    """``eapctl decode``: one frame, and for a capture the packet that it was in.

    Each type has fields of its own: ``publisher``, ``cycle`` and ``pds`` type 4, ``datagrams``
    type 1, ``ams`` type 2, ``mailbox`` type 5, raw ``data`` all others.  Bytes are strings of
    hexadecimal digits.  *error* is None if all is well.

    *needed_length* is there if the PDs are whole, but not where *length* says; *cycle_order* is
    ``swapped`` if earlier frames of the publisher show that it swaps the bytes of its counter.
    """

    type: int | None = None
    length: int | None = None
    publisher: str | UnsetType | None = UNSET
    cycle: int | UnsetType | None = UNSET
    cycle_order: str | UnsetType = UNSET
    needed_length: int | UnsetType = UNSET
    pds: list[DecodedPd] | UnsetType = UNSET
    datagrams: list[DecodedDatagram] | UnsetType = UNSET
    ams: DecodedAms | UnsetType | None = UNSET
    mailbox: DecodedMailbox | UnsetType | None = UNSET
    data: str | UnsetType = UNSET
    error: str | None = None
    packet: int | UnsetType = UNSET
    time: float | UnsetType = UNSET
    transport: str | UnsetType = UNSET
    source: str | UnsetType = UNSET
    destination: str | UnsetType = UNSET
    vlan_id: int | UnsetType = UNSET


def decode_frame(data: Buffer) -> DecodedFrame:
    """Return the fields of one frame, which starts at the EtherCAT header; padding is ignored."""
    found = DecodedFrame()
    try:
        header = EtherCatHeader.decode(data)
    except CodecError as exc:
        found.error = str(exc)
        return found
    found.type, found.length = header.type, header.length
    end = EtherCatHeader.SIZE + header.length
    if header.type == FrameType.PROCESS_DATA and _read_by_pds(data, found):
        return found
    try:
        _READERS.get(header.type, _read_raw)(memoryview(data)[:end], found)
    except CodecError as exc:
        found.error = str(exc)
    if end > len(data):
        there = len(data) - EtherCatHeader.SIZE
        # Set last: that bytes are missing explains any error that decoding met at the end.
        found.error = (
            f"EtherCatHeader at offset 0: length {header.length}, but {there} bytes follow"
        )
    return found


def _read_by_pds(data: Buffer, found: DecodedFrame) -> bool:
    """Read a frame whose Length is wrong by the lengths of its PDs; return False for all others."""
    try:
        frame = follow_pds(data)
    except CodecError:
        return False
    if not frame.has_wrong_length:
        return False
    found.publisher, found.cycle = str(frame.header.publisher), frame.header.cycle
    found.pds = [_decoded_pd(pd, content) for pd, content in frame.pds]
    found.needed_length = frame.needed
    found.error = (
        f"EtherCatHeader at offset 0: wrong length {frame.length}: its PDs take {frame.needed} "
        "bytes; ports with length: lenient take the frame"
    )
    return True


def _decoded_pd(pd: PdHeader, data: memoryview) -> DecodedPd:
    return DecodedPd(pd.pd_id, pd.version, pd.length, pd.quality, data.hex())


def _read_process_data(frame: memoryview, found: DecodedFrame) -> None:
    found.publisher = found.cycle = None
    found.pds = pds = []
    header = PdFrameHeader.decode(frame, PD_FRAME_START)
    found.publisher, found.cycle = str(header.publisher), header.cycle
    for pd, data in iter_pds(frame):
        pds.append(_decoded_pd(pd, data))


def _read_datagrams(frame: memoryview, found: DecodedFrame) -> None:
    found.datagrams = datagrams = []
    for header, data, wkc in iter_datagrams(frame):
        is_logical = header.command.is_logical
        datagrams.append(
            DecodedDatagram(
                command=header.command.name,
                index=header.index,
                adp=UNSET if is_logical else header.adp,
                ado=UNSET if is_logical else header.ado,
                address=header.logical_address if is_logical else UNSET,
                length=header.length,
                circulating=bool(header.circulating),
                irq=header.irq,
                data=bytes(data).hex(),
                wkc=wkc,
            )
        )


def _read_ams(frame: memoryview, found: DecodedFrame) -> None:
    found.ams = None
    found.ams = _decoded_ams(frame[EtherCatHeader.SIZE :])


def _decoded_ams(packet: memoryview) -> DecodedAms:
    header, data = ams.decode_packet(packet)
    return DecodedAms(
        target=str(header.target),
        target_port=header.target_port,
        source=str(header.source),
        source_port=header.source_port,
        command=header.command,
        service=ams.AmsCommand.name_of(header.command),
        state_flags=header.state_flags,
        length=header.length,
        error_code=header.error_code,
        invoke_id=header.invoke_id,
        data=data.hex(),
    )


def _read_mailbox(frame: memoryview, found: DecodedFrame) -> None:
    found.mailbox = None
    header = MailboxHeader.decode(frame, EtherCatHeader.SIZE)
    found.mailbox = message = DecodedMailbox(
        length=header.length,
        address=header.address,
        channel=header.channel,
        priority=header.priority,
        type=int(header.type),
        protocol=header.type.title,
        counter=header.counter,
    )
    _, data = mailbox.decode_frame(frame)
    message.data = data.hex()
    if header.type is MailboxType.AOE:
        message.ams = _decoded_ams(data)
    elif header.type is MailboxType.COE:
        message.service = describe_message(data) or UNSET
    elif header.type is MailboxType.ERR:
        reply = MailboxErrorReply.decode(data)
        if reply.detail_type == mailbox.ERROR_REPLY and len(data) == MailboxErrorReply.SIZE:
            message.detail = reply.detail
            message.reason = MailboxError.name_of(reply.detail)


def _read_raw(frame: memoryview, found: DecodedFrame) -> None:
    found.data = frame[EtherCatHeader.SIZE :].hex()


_READERS: dict[int, Callable[[memoryview, DecodedFrame], None]] = {
    FrameType.DATAGRAM: _read_datagrams,
    FrameType.AMS: _read_ams,
    FrameType.PROCESS_DATA: _read_process_data,
    FrameType.MAILBOX: _read_mailbox,
}


_MOST_PUBLISHERS = 4096


class CycleOrders:
    """Order of the bytes of the cycle counters of all publishers in a capture."""

    def __init__(self) -> None:
        self._watches: dict[str, CycleWatch] = {}

    def enter(self, frame: DecodedFrame) -> None:
        """Note the counter of *frame*, and mark the frame if its publisher swaps the bytes."""
        if not frame.publisher or not isinstance(frame.cycle, int):
            return
        if frame.publisher not in self._watches and len(self._watches) >= _MOST_PUBLISHERS:
            self._watches.clear()
        watch = self._watches.setdefault(frame.publisher, CycleWatch())
        watch.enter(frame.cycle)
        if watch.order is CycleOrder.SWAPPED:
            frame.cycle_order = CycleOrder.SWAPPED.value
