"""The files of slaves behind index groups, by FoE (Ads.h of the TwinCAT SDK; ETG.1000.6).

A file is opened by its name, read or written in blocks by a handle, and closed; Read and Write do
as well as the ReadWrite that TwinCAT's clients send.  Own format: what cannot be answered in time
is answered BUSY, has done nothing, and is to be asked again; what FOE_PROGRESS answers; and that a
ReadWrite of it with any data gives the file up, where closing it would make it complete.  Data of
a close means nothing: some clients cannot write none.  Handles belong to the NetID that opened
them, through whichever connection it comes; a file that it has left open gives way to its next one
at that slave, which takes one at a time.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Awaitable, Collection
from typing import TypeVar

from devicebus.wire.sii import SiiProtocol
from eap.aoe.ads_operation import AdsRefusedError
from eap.appliance.handover import PortName
from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.bus_ads.slave_space import Asked, SlaveSpace
from eap.appliance.services.bus_ads.transfer import Transfer
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.mailbox import MailboxType
from eap.errors import EapError
from eap.ids import NetId

T = TypeVar("T")

ANSWER_S = 3.0
"""How long one request may take."""
IDLE_S = 30.0
"""A file for which nothing is asked for so long is closed: others may wait for the slave."""
LEFT_S = 2.0
"""A file for which nothing is asked for so long gives way to the next one of its owner.

Shorter than ANSWER_S, so that the next one has its turn when it asks for the first time; longer
than the pauses between the blocks of a transfer, since several programs may share one NetID.
"""
MAX_OF_CLIENT = 8
"""Files that a NetID may have open."""
MAX_OPEN = 64
MAX_BLOCK = 1 << 19
"""Octets of the longest block."""
_HANDLE_SIZE = 4

logger = logging.getLogger(__name__)


class _Open:
    """A file that somebody has open."""

    def __init__(self, owner: NetId, station: int, what: str, transfer: Transfer) -> None:
        self.owner = owner
        self.station = station
        self.what = what
        self.transfer = transfer
        self.task: asyncio.Task[None] | None = None
        self.idle: asyncio.TimerHandle | None = None
        self.idle_since_s: float | None = None
        """None while something is being done with it."""


class SlaveFiles(SlaveSpace):
    """Files that are open, and those that may be opened."""

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
    protocol = SiiProtocol.FOE

    def __init__(self, bus: BusClient, port: PortName) -> None:
        super().__init__(bus, port)
        self._open: dict[int, _Open] = {}

    async def read(self, asked: Asked, group: int, offset: int, length: int) -> bytes:
        """Return a block or how far a transfer is."""
        return await self.read_write(asked, group, offset, length, b"")

    async def write(self, asked: Asked, group: int, offset: int, data: bytes) -> None:
        """Take a block, or close a file."""
        if group not in {IndexGroup.FOE_WRITE, IndexGroup.FOE_CLOSE}:
            raise AdsRefusedError(AdsError.SERVICE, "a file is opened by ReadWrite")
        await self.read_write(asked, group, offset, 0, data)

    async def read_write(
        self, asked: Asked, group: int, offset: int, length: int, data: bytes
    ) -> bytes:
        """Open a file, or do something with the one that the handle *offset* names."""
        if group in {IndexGroup.FOE_OPEN_READ, IndexGroup.FOE_OPEN_WRITE}:
            if length < _HANDLE_SIZE:
                raise AdsRefusedError(AdsError.SIZE, "a handle has four octets")
            is_write = group == IndexGroup.FOE_OPEN_WRITE
            return await self._begin(asked, data, offset, is_write=is_write)
        if max(len(data), length) > MAX_BLOCK:
            raise AdsRefusedError(AdsError.SIZE, f"a block has at most {MAX_BLOCK} octets")
        if data and group == IndexGroup.FOE_READ:
            raise AdsRefusedError(AdsError.SIZE, "nothing is written here")
        item = self._find(asked, offset)
        self._end_idle(item)
        try:
            return await self._do(item, offset, group, length, data)
        finally:
            if offset in self._open:
                self._begin_idle(offset)

    async def _begin(self, asked: Asked, name: bytes, password: int, *, is_write: bool) -> bytes:
        owner, station = asked.client.net_id, asked.slave.station
        self._replace_left(owner, station)
        self._check_room(owner)
        what = _text(name)
        transfer = Transfer(what, password, asked.sizes, is_write=is_write)
        item = _Open(owner, station, f"file {what!r} of slave {station}", transfer)
        handle = self._new_handle()
        self._open[handle] = item
        # By the handle, not by the client: two of its files are two that want a turn.
        talk = self.bus.open_talk
        opening = transfer.run(lambda: talk(self.port, station, MailboxType.FOE, handle))
        item.task = asyncio.get_running_loop().create_task(opening)
        try:
            await _in_time(transfer.wait_open(), "")
        except AdsRefusedError:
            if not transfer.has_turn:
                self._drop(handle)
                why = f"another file goes to slave {station} or comes from it"
                raise AdsRefusedError(AdsError.BUSY, why) from None
            # It takes its time, as to make room in a flash memory: the next request waits on.
        except BaseException:
            self._drop(handle)
            raise
        self._begin_idle(handle)
        return handle.to_bytes(_HANDLE_SIZE, "little")

    async def _do(self, item: _Open, handle: int, group: int, length: int, data: bytes) -> bytes:
        transfer = item.transfer
        match group:
            case IndexGroup.FOE_PROGRESS if data:
                self._drop(handle)
            case IndexGroup.FOE_PROGRESS:
                return _progress(transfer)[:length]
            case IndexGroup.FOE_READ | IndexGroup.FOE_WRITE:
                if transfer.is_write is not (group == IndexGroup.FOE_WRITE):
                    done = "written" if transfer.is_write else "read"
                    raise AdsRefusedError(AdsError.ACCESS, f"{item.what} is being {done}")
                if not transfer.is_write:
                    return await _in_time(transfer.read(length), item.what)
                if transfer.is_whole:
                    raise AdsRefusedError(AdsError.STATE, f"{item.what} is being closed")
                await _in_time(transfer.write(data), item.what)
            case _:
                await self._finish(item, handle)
        return b""

    async def _finish(self, item: _Open, handle: int) -> None:
        """Close a file; one that is being written is complete only now."""
        if item.transfer.is_write:
            try:
                await _in_time(item.transfer.finish(), item.what)
            except EapError:
                self._drop(handle)
                raise
        self._drop(handle)

    def _replace_left(self, owner: NetId, station: int) -> None:
        """Give up files of *owner* at a slave that it has left open, now or when it is time."""
        loop = asyncio.get_running_loop()
        for handle, item in list(self._open.items()):
            if (item.owner, item.station) != (owner, station) or item.idle_since_s is None:
                continue
            left_at_s = item.idle_since_s + LEFT_S
            if left_at_s <= loop.time():
                self._give_up_left(handle, item.idle_since_s)
            elif item.transfer.has_turn:
                loop.call_at(left_at_s, self._give_up_left, handle, item.idle_since_s)

    def _give_up_left(self, handle: int, since_s: float) -> None:
        """Give a file up if nothing has been asked for it since then."""
        item = self._open.get(handle)
        if item is not None and item.idle_since_s == since_s:
            logger.info("%s given up: %s left it open and opens another one", item.what, item.owner)
            self._drop(handle)

    def _check_room(self, owner: NetId) -> None:
        of_client = sum(item.owner == owner for item in self._open.values())
        if of_client >= MAX_OF_CLIENT or len(self._open) >= MAX_OPEN:
            why = f"{len(self._open)} files are open, {of_client} of them by {owner}"
            raise AdsRefusedError(AdsError.NO_MORE_HANDLES, why)

    def _new_handle(self) -> int:
        handle = 0
        while not handle or handle in self._open:
            handle = secrets.randbits(8 * _HANDLE_SIZE)
        return handle

    def _find(self, asked: Asked, handle: int) -> _Open:
        item = self._open.get(handle)
        place = asked.client.net_id, asked.slave.station
        if item is None or (item.owner, item.station) != place:
            why = f"slave {place[1]}: {place[0]} has no file open by the handle 0x{handle:X}"
            raise AdsRefusedError(AdsError.INDEX_OFFSET, why)
        return item

    def _begin_idle(self, handle: int) -> None:
        item = self._open[handle]
        self._end_idle(item)
        loop = asyncio.get_running_loop()
        item.idle_since_s = loop.time()
        item.idle = loop.call_later(IDLE_S, self._expire, handle)

    def _end_idle(self, item: _Open) -> None:
        item.idle_since_s = None
        if item.idle is not None:
            item.idle.cancel()

    def _expire(self, handle: int) -> None:
        item = self._open[handle]
        logger.info("%s closed: %s has asked for nothing for %g s", item.what, item.owner, IDLE_S)
        self._drop(handle)

    def _drop(self, handle: int) -> None:
        item = self._open.pop(handle, None)
        if item is None:
            return
        self._end_idle(item)
        if item.task is not None:
            item.task.cancel()


async def _in_time(work: Awaitable[T], what: str) -> T:
    try:
        async with asyncio.timeout(ANSWER_S):
            return await work
    except TimeoutError:
        raise AdsRefusedError(AdsError.BUSY, f"{what}: not yet, ask again") from None


def _text(name: bytes) -> str:
    try:
        return name.rstrip(b"\0").decode()
    except UnicodeDecodeError:
        raise AdsRefusedError(AdsError.VALUE, "a file name that is no UTF-8") from None


def _progress(transfer: Transfer) -> bytes:
    """Octets so far, and 1 if these are all and there was no error, of 32 bits each."""
    done = min(transfer.progress.done, 0xFFFF_FFFF)
    return done.to_bytes(4, "little") + transfer.is_complete.to_bytes(4, "little")
