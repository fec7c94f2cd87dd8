"""Access to a slave, or the master, of another station: each operation is one request by AoE.

A refusal comes back as an error of ADS; it is raised with the code of the protocol that comes
nearest, and as RemoteAccessError where no code does or the slave was not reached (ETG.1020).

A file goes in blocks.  The first one is as long as a packet of FoE, so that the client need not
wait for more than it wants; each is twice as long as the one before, up to BLOCK.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Protocol

from devicebus.errors import FoeError, SoeError
from devicebus.mailbox.conversation import MailboxMessage
from devicebus.mailbox.eoe import FrameAssembler
from devicebus.mailbox.protocol import MailboxSizes
from eap.ads.request import (
    Operation,
    Read,
    ReadState,
    ReadWrite,
    Write,
    decode_outcome,
    encode_query,
)
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import DEVICE_PORT, AmsAnswer, AmsCommand, AmsHeader, StateFlags, response_to
from eap.codec.coe import EntryRequest, ListRequest, ObjectRequest, SdoInfoOpcode
from eap.codec.eoe import EoeHeader, EoeType, ResultWord, split_counted
from eap.codec.foe import DATA_OVERHEAD
from eap.codec.foe import name_of as name_of_foe
from eap.codec.mailbox import MailboxType
from eap.codec.soe import SoeErrorCode, name_of
from eap.gateway.error_table import cause_of_result
from eap.od.abort import AbortCode, SdoAbortError
from eap.services.slaves.access import ObjectStream, RemoteAccessError
from eap.services.slaves.file_stream import AHEAD, FileStream

# By datagrams, one that is lost costs the whole block.
BLOCK = 16 << 10
"""Octets of the longest block."""
# Routers give up after 4.5 s.
STEP_S = 5.0
"""Time limit of the answer to a block."""
PAUSE_S = 0.02
"""Pause before a station that is busy gets the request again."""
_HANDLE_SIZE = 4
_ABORT = b"\1"
LONGEST_SETTINGS = 1 << 10
"""Bytes of the longest answer about Ethernet settings."""
LONGEST_ANSWER = 0x20002
"""Octets of the longest answer: a list of all indexes there can be."""
SHORT_WRITE = 1 << 10
"""Octets of an object that goes to a slave in a few messages."""
LONG_WRITE_FACTOR = 5
"""Answer times that writing a longer one may take."""
_COMPLETE = 0x100
_ADDRESSES, _SLAVES = 0xF020, 0x8000
_TO_SLAVE, _TO_MASTER = 33, 34
_LISTS, _LISTED = 16, 255
"""Objects from 0xF020 on, and addresses in each."""
_INFO_GROUPS = {
    SdoInfoOpcode.LIST_REQUEST: IndexGroup.OBJECT_LIST,
    SdoInfoOpcode.OBJECT_REQUEST: IndexGroup.OBJECT_DESCRIPTION,
    SdoInfoOpcode.ENTRY_REQUEST: IndexGroup.ENTRY_DESCRIPTION,
}
_FORWARDED = frozenset(
    (
        AmsCommand.READ_DEVICE_INFO,
        AmsCommand.READ,
        AmsCommand.WRITE,
        AmsCommand.READ_STATE,
        AmsCommand.WRITE_CONTROL,
        AmsCommand.READ_WRITE,
    )
)
"""Notifications are not: nothing would bring them back to the client."""


class AmsRequester(Protocol):
    """Sends requests to ports behind one NetID; every failure is an error of the answer."""

    async def __call__(
        self, port: int, command: int, body: bytes, *, timeout_s: float
    ) -> AmsAnswer:
        """Return the answer."""


class RemoteSlave:
    """A slave of another station; a SlaveAccess.

    Args:
        request: Sends requests to the NetID of its bus.
        port: AMS port of the slave; 0xFFFF is the master.
        answer_s: Limit for the answer to a request.
    """

    def __init__(self, request: AmsRequester, port: int, answer_s: float) -> None:
        self._request = request
        self._port = port
        self._answer_s = answer_s
        self._assembler = FrameAssembler()

    async def sizes(self) -> MailboxSizes:
        """Return the sizes of the slave's mailboxes, from the dictionary of its master (ETG.1510).

        Raises:
            RemoteAccessError: the master does not tell them.
        """
        if self._port == DEVICE_PORT:
            raise RemoteAccessError(AdsError.SERVICE)  # a master has no mailbox
        try:
            index = _SLAVES + await self._slave_number()
            return MailboxSizes(
                await self._read_number(index, _TO_SLAVE),
                await self._read_number(index, _TO_MASTER),
            )
        except ValueError:
            raise RemoteAccessError(AdsError.NOT_READY) from None
        except RemoteAccessError as exc:
            if exc.is_routing_error:
                raise
            # The master's dictionary refused, which says nothing about the slave.
            raise RemoteAccessError(AdsError.SERVICE) from None

    async def probe(self) -> None:
        """Raise RemoteAccessError if the other station does not answer."""
        try:
            await self.perform(ReadState())
        except RemoteAccessError as exc:
            if exc.is_routing_error:
                raise

    async def read_object(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Read an entry, or with *complete* an object from subindex 0 or 1 on."""
        offset = _sdo_offset(index, subindex, complete=complete)
        try:
            data = await self.perform(Read(IndexGroup.SDO, offset, LONGEST_ANSWER))
        except RemoteAccessError as exc:
            raise _sdo_error(exc, index, subindex) from None
        if complete and subindex:
            data = data[2:]  # by ADS an object comes from subindex 0 on, which is 16 bits wide
        return data

    async def open_object(
        self, index: int, subindex: int, *, complete: bool = False
    ) -> ObjectStream:
        """Read as :meth:`read_object` does: by ADS all of an object comes at once."""
        data = await self.read_object(index, subindex, complete=complete)
        return ObjectStream(len(data), data)

    async def write_object(
        self, index: int, subindex: int, data: bytes, *, complete: bool = False
    ) -> None:
        """Write an entry, or with *complete* an object from subindex 0 on."""
        if complete and subindex:
            detail = "by ADS an object is written from subindex 0 on"
            raise SdoAbortError(AbortCode.NO_COMPLETE_ACCESS, index, subindex, detail)
        offset = _sdo_offset(index, subindex, complete=complete)
        # The other station answers when its slave has all of it.
        times = LONG_WRITE_FACTOR if len(data) > SHORT_WRITE else 1
        try:
            await self.perform(
                Write(IndexGroup.SDO, offset, data), timeout_s=times * self._answer_s
            )
        except RemoteAccessError as exc:
            raise _sdo_error(exc, index, subindex) from None

    async def write_unsized(self, index: int, subindex: int, octets: bytes) -> None:
        """Write an entry from four bytes of which as many count as the entry has."""
        # ADS has no write without a length: the entry's present value tells it.
        size = len(await self.read_object(index, subindex))
        await self.write_object(index, subindex, octets[:size])

    async def read_info(self, opcode: SdoInfoOpcode, request: bytes) -> bytes:
        """Return the body of an SDO information answer."""
        index = subindex = 0
        match opcode:
            case SdoInfoOpcode.LIST_REQUEST:
                offset = ListRequest.decode(request).list_type << 16
            case SdoInfoOpcode.OBJECT_REQUEST:
                index = ObjectRequest.decode(request).index
                offset = index << 16
            case SdoInfoOpcode.ENTRY_REQUEST:
                entry = EntryRequest.decode(request)
                index, subindex = entry.index, entry.subindex
                offset = index << 16 | entry.value_info << 8 | subindex
            case _:
                raise RemoteAccessError(AdsError.SERVICE)
        try:
            return await self.perform(Read(_INFO_GROUPS[opcode], offset, LONGEST_ANSWER))
        except RemoteAccessError as exc:
            raise _sdo_error(exc, index, subindex) from None

    async def read_elements(self, idn: int, elements: int, *, drive: int) -> bytes:
        """Read elements of an IDN, one behind the other; lists and texts with their heads."""
        offset = _soe_offset(idn, elements, drive)
        try:
            return await self.perform(Read(IndexGroup.SOE, offset, LONGEST_ANSWER))
        except RemoteAccessError as exc:
            raise _soe_error(exc) from None

    async def write_elements(self, idn: int, elements: int, data: bytes, *, drive: int) -> None:
        """Write an element of an IDN; a list or text with its head."""
        try:
            await self.perform(Write(IndexGroup.SOE, _soe_offset(idn, elements, drive), data))
        except RemoteAccessError as exc:
            raise _soe_error(exc) from None

    def open_file(
        self, name: str, password: int, *, is_write: bool, ahead: int = AHEAD
    ) -> RemoteFile:
        """Begin to move a file, *ahead* bytes before its reader; it is closed by the caller."""
        return RemoteFile(self, name, password, is_write=is_write, ahead=ahead)

    async def exchange_vendor(self, message: bytes) -> bytes:
        """Return the answer to a VoE message, both with their VoE headers."""
        return await self.perform(ReadWrite(IndexGroup.VOE, 0, LONGEST_ANSWER, message))

    async def send_vendor(self, message: bytes) -> None:
        """Send a VoE message that is not answered."""
        await self.perform(Write(IndexGroup.VOE, 0, message))

    async def exchange_ads(self, header: AmsHeader, data: bytes) -> bytes:
        """Return the AMS packet that answers an AoE request; nothing if it wants no answer."""
        if header.command not in _FORWARDED:
            raise RemoteAccessError(AdsError.SERVICE)
        # The packet's target is not looked at: the slave is the one that this access leads to.
        answer = await self._request(self._port, header.command, data, timeout_s=self._answer_s)
        if header.state_flags & StateFlags.NO_RETURN:
            return b""
        return response_to(header, answer)

    async def exchange(
        self, kind: MailboxType, request: bytes, *, expects_reply: bool = True
    ) -> MailboxMessage:
        """Pass a message of EoE, in an own format of ADS; refuse those of other protocols.

        Raises:
            CodecError: the message is cut.
        """
        del expects_reply  # its type says that
        if kind is not MailboxType.EOE:
            raise RemoteAccessError(AdsError.SERVICE)
        header = EoeHeader.decode(request)
        if header.type is not EoeType.FRAGMENT:
            body = request[EoeHeader.SIZE + ResultWord.SIZE :]
            answer = await self.perform(
                ReadWrite(IndexGroup.EOE, header.type, LONGEST_SETTINGS, body)
            )
            return MailboxMessage(kind, answer)
        # Whole frames: the slave's mailbox may be smaller than the fragments of the client.
        frame = self._assembler.receive(request)
        if frame is not None:
            await self.perform(Write(IndexGroup.EOE, 0, frame))
        return MailboxMessage(kind, b"")

    async def read_frames(self, reader: int) -> list[bytes]:
        """Return the Ethernet frames that the slave has sent since the last call.

        Args:
            reader: Number of the caller at the other station.
        """
        number = reader.to_bytes(4, "little")
        fetch = ReadWrite(IndexGroup.EOE, EoeType.FRAGMENT, BLOCK, number)
        return split_counted(await self.perform(fetch))

    async def perform(
        self, operation: Operation, *, port: int | None = None, timeout_s: float | None = None
    ) -> bytes:
        """Execute an operation; return the data read.

        Args:
            operation: To be done by the slave.
            port: Of another device behind the same NetID.
            timeout_s: Limit for the answer, if it is another one than usual.

        Raises:
            RemoteAccessError: it was not done.
        """
        command, body = encode_query(operation)
        answer = await self._request(
            self._port if port is None else port,
            command,
            body,
            timeout_s=timeout_s or self._answer_s,
        )
        outcome = decode_outcome(command, answer.error_code, answer.data)
        if outcome.result:
            raise RemoteAccessError(outcome.result)
        return outcome.data

    async def _slave_number(self) -> int:
        """Return the number of the slave in the lists of its master."""
        for number in range(_LISTS):
            offset = _sdo_offset(_ADDRESSES + number, 0, complete=True)
            listed = await self.perform(
                Read(IndexGroup.SDO, offset, 2 + 2 * _LISTED), port=DEVICE_PORT
            )
            positions = range(2, min(len(listed) - 1, 2 + 2 * _LISTED), 2)
            stations = [int.from_bytes(listed[at : at + 2], "little") for at in positions]
            if self._port in stations:
                return number * _LISTED + stations.index(self._port)
            if len(stations) < _LISTED:
                break
        raise RemoteAccessError(AdsError.TARGET_PORT)

    async def _read_number(self, index: int, subindex: int) -> int:
        read = Read(IndexGroup.SDO, _sdo_offset(index, subindex, complete=False), 2)
        return int.from_bytes(await self.perform(read, port=DEVICE_PORT), "little")


class RemoteFile(FileStream):
    """A file of a slave of another station, which does not report turns.

    Args:
        slave: Owner of the file.
        name: Of the file, at the slave.
        password: Up to 32 bits.
        is_write: Whether it goes to the slave.
        ahead: Bytes that are read before the client wants them.
    """

    def __init__(
        self, slave: RemoteSlave, name: str, password: int, *, is_write: bool, ahead: int = AHEAD
    ) -> None:
        super().__init__(name, MailboxSizes(), is_write=is_write, ahead=ahead)
        self._slave = slave
        self._password = password
        self._handle = 0
        self._is_closed = False

    def close(self) -> None:
        """Abort the file if it is not complete, at the slave too."""
        self._is_closed = True
        if self.is_open:  # else the handle that closes it there is not known yet
            super().close()

    async def move(self) -> None:
        """Move the file in blocks."""
        try:
            await self._open()
            await (self._drain() if self.is_write else self._fill())
        except RemoteAccessError as exc:
            raise _foe_error(exc) from None

    async def run(self) -> None:
        """Move the file, and close it at the other station once its reader or writer knows."""
        try:
            await super().run()
        finally:
            await self._close_remote()

    async def _open(self) -> None:
        sizes = await self._slave.sizes()
        self.sizes.set(sizes.to_slave, sizes.to_master)
        self._check_open()  # a slave may forget its old file as soon as a new one is begun
        group = IndexGroup.FOE_OPEN_WRITE if self.is_write else IndexGroup.FOE_OPEN_READ
        opened = await self._request_block(group, self._password, _HANDLE_SIZE, self.name.encode())
        self._handle = int.from_bytes(opened, "little")
        self.notify(has_lock=True, is_open=True)
        self._check_open()

    def _check_open(self) -> None:
        if self._is_closed:
            raise RemoteAccessError(AdsError.ABORTED)

    async def _fill(self) -> None:
        size = self.sizes.to_master - DATA_OVERHEAD
        is_last = False
        while not is_last:
            await self.wait_space()
            data = await self._request_block(IndexGroup.FOE_READ, self._handle, size)
            self.buffer += data
            self.progress.done += len(data)
            self.notify()
            # By ADS a file ends with a block shorter than requested.
            is_last = len(data) < size
            # The first block comes soon, later ones save round trips.
            size = min(2 * size, BLOCK)

    async def _drain(self) -> None:
        while self.buffer or not self.is_finished:
            await self.wait_data(1)
            if block := bytes(self.buffer[:BLOCK]):
                await self._request_block(IndexGroup.FOE_WRITE, self._handle, 0, block)
                self.progress.done += len(block)
                self.pop(len(block))
        await self._request_block(IndexGroup.FOE_CLOSE, self._handle)

    async def _close_remote(self) -> None:
        """Close the file at the slave; an incomplete write is discarded."""
        if not self.is_open or (self.is_write and self.is_complete):
            return
        last = ReadWrite(IndexGroup.FOE_CLOSE, self._handle, 0, b"")
        if self.is_write:
            last = ReadWrite(IndexGroup.FOE_PROGRESS, self._handle, 0, _ABORT)
        with suppress(RemoteAccessError):
            await self._slave.perform(last)

    async def _request_block(
        self, group: int, offset: int, length: int = 0, data: bytes = b""
    ) -> bytes:
        """Send a request, and again as long as the answer is BUSY and the file is wanted."""
        while True:
            try:
                return await self._slave.perform(
                    ReadWrite(group, offset, length, data), timeout_s=STEP_S
                )
            except RemoteAccessError as exc:
                # BUSY has done nothing at the other station, so the same request is safe to repeat.
                if exc.result != AdsError.BUSY or self._is_closed:
                    raise
            await asyncio.sleep(PAUSE_S)


def _sdo_offset(index: int, subindex: int, *, complete: bool) -> int:
    return index << 16 | (_COMPLETE if complete else subindex)


def _soe_offset(idn: int, elements: int, drive: int) -> int:
    return drive << 24 | elements << 16 | idn


def _sdo_error(
    error: RemoteAccessError, index: int, subindex: int
) -> RemoteAccessError | SdoAbortError:
    if error.is_routing_error:
        return error
    return SdoAbortError(cause_of_result(error.result).sdo, index, subindex)


def _soe_error(error: RemoteAccessError) -> RemoteAccessError | SoeError:
    code = cause_of_result(error.result).soe
    if error.is_routing_error or code is SoeErrorCode.GENERAL:
        return error
    return SoeError(name_of(code), code=code)


def _foe_error(error: RemoteAccessError) -> RemoteAccessError | FoeError:
    """Return the error with an FoE code; routing errors stay as they are."""
    if error.is_routing_error:
        return error
    code = cause_of_result(error.result).foe
    text = f"{name_of_foe(code)}: ADS error 0x{error.result:x} ({AdsError.name_of(error.result)})"
    return FoeError(text, code=code, text=text)
