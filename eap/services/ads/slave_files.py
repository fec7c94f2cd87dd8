"""ADS services of the files of slaves, by FoE (Ads.h of the TwinCAT SDK; ETG.1000.6).

A file is opened by its name, read or written in blocks by a handle, and closed; Read and Write do
as well as the ReadWrite that TwinCAT's clients send.  Own format: a request that cannot be answered
in time is answered BUSY, has done nothing, and is to be sent again; the answer to FOE_PROGRESS; and
that a ReadWrite of it with any data gives the file up, where closing it would make it complete.
Data of a close means nothing: some clients cannot write none.  Handles belong to the NetID that
opened them, through whichever connection it comes; a file that it has left open gives way to its
next one at that slave, which takes one at a time.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Awaitable, Collection
from typing import TypeVar

from eap.ads.notifications import AdsClient
from eap.ads.request import AdsRefusedError, Read, ReadWrite, Write
from eap.codec.ads import AdsError, IndexGroup
from eap.errors import EapError
from eap.ids import NetId
from eap.services.slaves.access import SlaveAccess
from eap.services.slaves.file_stream import FileStream

T = TypeVar("T")

FILE_BLOCK_S = 3.0
"""Time limit of one request."""
# Other clients may wait for the slave.
IDLE_S = 30.0
"""A file without requests for so long is closed."""
# Shorter than FILE_BLOCK_S, so that the next one has its turn at its first request; longer than the
# pauses between the blocks of a transfer, since several programs may share one NetID.
ABANDONED_S = 2.0
"""A file without requests for so long gives way to the next one of its owner."""
MAX_OF_CLIENT = 8
"""Files that a NetID may have open."""
MAX_OPEN = 64
MAX_BLOCK = 1 << 19
"""Octets of the longest block."""
_HANDLE_SIZE = 4
_OPENED = frozenset((IndexGroup.FOE_OPEN_READ, IndexGroup.FOE_OPEN_WRITE))
_WRITTEN = frozenset((IndexGroup.FOE_WRITE, IndexGroup.FOE_CLOSE))

logger = logging.getLogger(__name__)


class _OpenFile:
    """A file with a handle."""

    def __init__(self, owner: NetId, station: int, name: str, stream: FileStream) -> None:
        self.owner = owner
        self.station = station
        self.name = name
        self.stream = stream
        self.idle: asyncio.TimerHandle | None = None
        self.idle_since_s: float | None = None
        """None while something is being done with it."""


class SlaveFiles:
    """Files of the slaves on one bus that clients have open."""

    groups: Collection[int] = frozenset(
        (
            IndexGroup.FOE_OPEN_READ,
            IndexGroup.FOE_OPEN_WRITE,
            IndexGroup.FOE_CLOSE,
            IndexGroup.FOE_READ,
            IndexGroup.FOE_WRITE,
            IndexGroup.FOE_PROGRESS,
        )
    )

    def __init__(self) -> None:
        self._open: dict[int, _OpenFile] = {}

    async def perform(
        self,
        access: SlaveAccess,
        station: int,
        client: AdsClient,
        operation: Read | Write | ReadWrite,
    ) -> bytes:
        """Open a file, or do something with the one that the operation's offset names."""
        group, offset = operation.group, operation.offset
        length = 0 if isinstance(operation, Write) else operation.length
        data = b"" if isinstance(operation, Read) else operation.data
        if isinstance(operation, Write) and group not in _WRITTEN:
            raise AdsRefusedError(AdsError.SERVICE, "a file is opened by ReadWrite")
        if group in _OPENED:
            if length < _HANDLE_SIZE:
                raise AdsRefusedError(AdsError.SIZE, "a handle has four bytes")
            is_write = group == IndexGroup.FOE_OPEN_WRITE
            return await self._begin(access, station, client, data, offset, is_write=is_write)
        if max(len(data), length) > MAX_BLOCK:
            raise AdsRefusedError(AdsError.SIZE, f"a block has at most {MAX_BLOCK} bytes")
        if data and group == IndexGroup.FOE_READ:
            raise AdsRefusedError(AdsError.SIZE, "a read of a file takes no data")
        item = self._find(station, client, offset)
        self._end_idle(item)
        try:
            return await self._handle(item, offset, group, length, data)
        finally:
            if offset in self._open:
                self._begin_idle(offset)

    async def _begin(
        self,
        access: SlaveAccess,
        station: int,
        client: AdsClient,
        name: bytes,
        password: int,
        *,
        is_write: bool,
    ) -> bytes:
        owner = client.net_id
        # A slave handles one file at a time (ETG.1000.6): an abandoned one would block the next.
        self._drop_abandoned(owner, station)
        self._check_limits(owner)
        text = _text(name)
        stream = access.open_file(text, password, is_write=is_write)
        handle = self._new_handle()
        self._open[handle] = _OpenFile(owner, station, f"file {text!r} of slave {station}", stream)
        try:
            await _in_time(stream.wait_open(), "")
        except AdsRefusedError:
            if not stream.has_lock:
                self._drop(handle)
                why = f"another file goes to slave {station} or comes from it"
                raise AdsRefusedError(AdsError.BUSY, why) from None
            # It takes its time, as to make room in a flash memory: the next request waits on.
        except BaseException:
            self._drop(handle)
            raise
        self._begin_idle(handle)
        return handle.to_bytes(_HANDLE_SIZE, "little")

    async def _handle(
        self, item: _OpenFile, handle: int, group: int, length: int, data: bytes
    ) -> bytes:
        stream = item.stream
        match group:
            # Own format: closing would make an incomplete file complete.
            case IndexGroup.FOE_PROGRESS if data:
                self._drop(handle)
            case IndexGroup.FOE_PROGRESS:
                return _progress(stream)[:length]
            case IndexGroup.FOE_READ | IndexGroup.FOE_WRITE:
                if stream.is_write is not (group == IndexGroup.FOE_WRITE):
                    done = "written" if stream.is_write else "read"
                    raise AdsRefusedError(AdsError.ACCESS, f"{item.name} is being {done}")
                if not stream.is_write:
                    return await _in_time(stream.read(length), item.name)
                if stream.is_finished:
                    raise AdsRefusedError(AdsError.STATE, f"{item.name} is being closed")
                await _in_time(stream.write(data), item.name)
            case _:
                await self._finish(item, handle)
        return b""

    async def _finish(self, item: _OpenFile, handle: int) -> None:
        """Close a file; one that is being written is complete only now."""
        if item.stream.is_write:
            try:
                await _in_time(item.stream.finish(), item.name)
            except EapError:
                self._drop(handle)
                raise
        self._drop(handle)

    def _drop_abandoned(self, owner: NetId, station: int) -> None:
        """Drop files of *owner* at a slave that it has abandoned, now or when the time is over."""
        loop = asyncio.get_running_loop()
        for handle, item in list(self._open.items()):
            if (item.owner, item.station) != (owner, station) or item.idle_since_s is None:
                continue
            left_at_s = item.idle_since_s + ABANDONED_S
            if left_at_s <= loop.time():
                self._drop_if_abandoned(handle, item.idle_since_s)
            elif item.stream.has_lock:
                loop.call_at(left_at_s, self._drop_if_abandoned, handle, item.idle_since_s)

    def _drop_if_abandoned(self, handle: int, since_s: float) -> None:
        """Drop a file if there was no request for it since then."""
        item = self._open.get(handle)
        if item is not None and item.idle_since_s == since_s:
            logger.info("%s closed: %s abandoned it and opened another one", item.name, item.owner)
            self._drop(handle)

    def _check_limits(self, owner: NetId) -> None:
        of_client = sum(item.owner == owner for item in self._open.values())
        if of_client >= MAX_OF_CLIENT or len(self._open) >= MAX_OPEN:
            why = f"{len(self._open)} files are open, {of_client} of them by {owner}"
            raise AdsRefusedError(AdsError.NO_MORE_HANDLES, why)

    def _new_handle(self) -> int:
        handle = 0
        while not handle or handle in self._open:
            # Random: a handle from before a restart must not reach another file.
            handle = secrets.randbits(8 * _HANDLE_SIZE)
        return handle

    def _find(self, station: int, client: AdsClient, handle: int) -> _OpenFile:
        item = self._open.get(handle)
        # By NetID and not by connection: a client that reconnects goes on with its file.
        if item is None or (item.owner, item.station) != (client.net_id, station):
            why = f"slave {station}: {client.net_id} has no file open by the handle 0x{handle:X}"
            raise AdsRefusedError(AdsError.INDEX_OFFSET, why)
        return item

    def _begin_idle(self, handle: int) -> None:
        item = self._open[handle]
        self._end_idle(item)
        loop = asyncio.get_running_loop()
        item.idle_since_s = loop.time()
        item.idle = loop.call_later(IDLE_S, self._expire, handle)

    def _end_idle(self, item: _OpenFile) -> None:
        item.idle_since_s = None
        if item.idle is not None:
            item.idle.cancel()

    def _expire(self, handle: int) -> None:
        item = self._open[handle]
        logger.info("%s closed: no request of %s for %g s", item.name, item.owner, IDLE_S)
        self._drop(handle)

    def _drop(self, handle: int) -> None:
        item = self._open.pop(handle, None)
        if item is None:
            return
        self._end_idle(item)
        item.stream.close()


async def _in_time(work: Awaitable[T], what: str) -> T:
    try:
        async with asyncio.timeout(FILE_BLOCK_S):
            return await work
    except TimeoutError:
        raise AdsRefusedError(AdsError.BUSY, f"{what}: not ready: repeat the request") from None


def _text(name: bytes) -> str:
    try:
        # Clients written in C send the name with its terminating NUL.
        return name.rstrip(b"\0").decode()
    except UnicodeDecodeError:
        raise AdsRefusedError(AdsError.VALUE, "the file name is not UTF-8") from None


def _progress(stream: FileStream) -> bytes:
    """Octets so far, and 1 if these are all and there was no error, of 32 bits each."""
    done = min(stream.progress.done, 0xFFFF_FFFF)
    return done.to_bytes(4, "little") + stream.is_complete.to_bytes(4, "little")
