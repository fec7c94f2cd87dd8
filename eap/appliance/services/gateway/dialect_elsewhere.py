"""What the high-nibble dialect asks of slaves of other stations, done by AoE."""

from __future__ import annotations

import asyncio

from devicebus.mailbox.foe_server import NotReadyError
from devicebus.mailbox.protocol import MailboxSizes
from eap.aoe.ads_operation import Operation, Read, Write
from eap.appliance.services.gateway.dialect_task import DialectError, too_long
from eap.appliance.services.gateway.remote_file import RemoteFile, Wanted
from eap.appliance.services.gateway.remote_link import RemoteLink
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.soe import SoeHeader, SoeOpcode
from eap.gateway.dialect import (
    Failure,
    ReadFile,
    ReadIdn,
    ReadSdo,
    TalkVoe,
    Task,
    WriteIdn,
    WriteSdo,
)
from eap.gateway.elsewhere import (
    ROOM,
    ElsewhereError,
    abort_for,
    idn_query,
    reason_for,
    sdo_offset,
    vendor_query,
)
from eap.gateway.error_table import cause_of_result


async def perform_elsewhere(task: Task, link: RemoteLink, room: int) -> bytes:
    """Do a task with a slave elsewhere; return what was read.

    Args:
        task: What is to be done.
        link: Leads to the slave.
        room: Octets that can be read at most.

    Raises:
        DialectError: it was not done.
    """
    try:
        async with asyncio.timeout(link.answer_s):
            if isinstance(task, ReadFile):
                data = await _read_file(task.name, link, room)
            else:
                data = await link.perform(_query(task))
    except TimeoutError:
        raise _refusal(task, AdsError.TIMEOUT) from None
    except ElsewhereError as exc:
        raise _refusal(task, exc.result) from None
    if len(data) > room:
        raise too_long(room)
    return data


def _query(task: ReadSdo | WriteSdo | ReadIdn | WriteIdn | TalkVoe) -> Operation:
    match task:
        case ReadSdo(index, subindex, complete):
            return Read(IndexGroup.SDO, sdo_offset(index, subindex, complete=complete), ROOM)
        case WriteSdo(index, subindex, data):
            return Write(IndexGroup.SDO, sdo_offset(index, subindex, complete=False), data)
        case ReadIdn(idn, drive, element):
            return idn_query(SoeHeader(SoeOpcode.READ_REQUEST, 0, 0, drive, element, idn))
        case WriteIdn(idn, drive, element, data):
            return idn_query(SoeHeader(SoeOpcode.WRITE_REQUEST, 0, 0, drive, element, idn), data)
    return vendor_query(task.body)


async def _read_file(name: str, link: RemoteLink, room: int) -> bytes:
    if not name:
        raise DialectError(Failure.FILE_NAME, "no file name")
    file = RemoteFile(link, Wanted(name, 0, is_write=False), MailboxSizes())
    try:
        while True:
            try:
                return file.read(room + 1)
            except NotReadyError:
                await file.wait_change()
    finally:
        file.close()


def _refusal(task: Task, result: int) -> DialectError:
    reason = reason_for(result)
    if reason is not None:
        return DialectError(reason.dialect, reason.text, reason=reason)
    code = abort_for(result) if isinstance(task, ReadSdo | WriteSdo) else None
    return DialectError(cause_of_result(result).dialect, str(ElsewhereError(result)), code)
