"""One EtherCAT frame as plain values, for whoever wants to look at it.

Nothing is raised for what the octets say: what could be read before a fault is shown, and the fault
is named in ``error``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from devicebus.wire.datagram import iter_datagrams
from eap.codec import ams, mailbox
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.mailbox import MailboxError, MailboxErrorReply, MailboxHeader, MailboxType
from eap.codec.pd import PD_FRAME_START, PdFrameHeader, iter_pds
from eap.codec.wire import Buffer
from eap.errors import CodecError

Fields: TypeAlias = dict[str, Any]

PROTOCOLS = {
    MailboxType.ERR: "error",
    MailboxType.AOE: "AoE",
    MailboxType.EOE: "EoE",
    MailboxType.COE: "CoE",
    MailboxType.FOE: "FoE",
    MailboxType.SOE: "SoE",
    MailboxType.VOE: "VoE",
}


def decode_frame(data: Buffer) -> Fields:
    """Return the fields of one frame, which starts at the EtherCAT header; padding is ignored.

    The keys are those of ``eapctl decode --json``: ``type``, ``length`` and ``error`` (None if all
    is well) in every frame; ``publisher``, ``cycle`` and ``pds`` in type 4, ``datagrams`` in
    type 1, ``ams`` in type 2, ``mailbox`` in type 5, raw ``data`` in all others.  Octets are
    strings of hexadecimal digits, quality is in units of 100 us.
    """
    fields: Fields = {"type": None, "length": None}
    try:
        header = EtherCatHeader.decode(data)
    except CodecError as exc:
        return fields | {"error": str(exc)}
    fields |= {"type": header.type, "length": header.length}
    end = EtherCatHeader.SIZE + header.length
    error = None
    try:
        _READERS.get(header.type, _read_raw)(memoryview(data)[:end], fields)
    except CodecError as exc:
        error = str(exc)
    if end > len(data):
        there = len(data) - EtherCatHeader.SIZE
        error = f"EtherCatHeader at offset 0: length {header.length}, but {there} octets follow"
    return fields | {"error": error}


def _read_process_data(frame: memoryview, fields: Fields) -> None:
    fields |= {"publisher": None, "cycle": None, "pds": []}
    header = PdFrameHeader.decode(frame, PD_FRAME_START)
    fields |= {"publisher": str(header.publisher), "cycle": header.cycle}
    for pd, data in iter_pds(frame):
        fields["pds"].append(
            {
                "id": pd.pd_id,
                "version": pd.version,
                "length": pd.length,
                "quality": pd.quality,
                "data": data.hex(),
            }
        )


def _read_datagrams(frame: memoryview, fields: Fields) -> None:
    fields["datagrams"] = []
    for header, data, wkc in iter_datagrams(frame):
        address: Fields = {"adp": header.adp, "ado": header.ado}
        if header.command.is_logical:
            address = {"address": header.logical_address}
        fields["datagrams"].append(
            {"command": header.command.name, "index": header.index}
            | address
            | {
                "length": header.length,
                "circulating": bool(header.circulating),
                "irq": header.irq,
                "data": bytes(data).hex(),
                "wkc": wkc,
            }
        )


def _read_ams(frame: memoryview, fields: Fields) -> None:
    fields["ams"] = None
    fields["ams"] = _ams_fields(frame[EtherCatHeader.SIZE :])


def _ams_fields(packet: memoryview) -> Fields:
    header, data = ams.decode_packet(packet)
    return {
        "target": str(header.target),
        "target_port": header.target_port,
        "source": str(header.source),
        "source_port": header.source_port,
        "command": header.command,
        "service": ams.AmsCommand.name_of(header.command),
        "state_flags": header.state_flags,
        "length": header.length,
        "error_code": header.error_code,
        "invoke_id": header.invoke_id,
        "data": data.hex(),
    }


def _read_mailbox(frame: memoryview, fields: Fields) -> None:
    fields["mailbox"] = None
    header = MailboxHeader.decode(frame, EtherCatHeader.SIZE)
    message: Fields = {
        "length": header.length,
        "address": header.address,
        "channel": header.channel,
        "priority": header.priority,
        "type": int(header.type),
        "protocol": PROTOCOLS[header.type],
        "counter": header.counter,
        "data": "",
    }
    fields["mailbox"] = message
    _, data = mailbox.decode_frame(frame)
    message["data"] = data.hex()
    if header.type is MailboxType.AOE:
        message["ams"] = _ams_fields(data)
    elif header.type is MailboxType.ERR:
        reply = MailboxErrorReply.decode(data)
        if reply.detail_type == mailbox.ERROR_REPLY and len(data) == MailboxErrorReply.SIZE:
            message["detail"] = reply.detail
            message["reason"] = MailboxError.name_of(reply.detail)


def _read_raw(frame: memoryview, fields: Fields) -> None:
    fields["data"] = frame[EtherCatHeader.SIZE :].hex()


_READERS: dict[int, Callable[[memoryview, Fields], None]] = {
    FrameType.DATAGRAM: _read_datagrams,
    FrameType.AMS: _read_ams,
    FrameType.PROCESS_DATA: _read_process_data,
    FrameType.MAILBOX: _read_mailbox,
}
