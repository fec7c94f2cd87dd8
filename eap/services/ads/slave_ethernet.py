"""Ethernet frames of slaves by ADS, through their EoE (own format).

A Write sends a frame to the slave.  A ReadWrite with offset 0 returns the frames that the slave has
sent since the last one, each behind its length as 16 bits; it writes a number of four bytes that
the client chooses, so that several readers of one NetID do not share frames.  A ReadWrite with
another offset passes a request for settings: the offset is its type, data and answer are as in the
mailbox.  Frames are not fetched by Read: what everybody may read are values, not the traffic of
others.

A reader that does not come back is forgotten.  What it does not fetch in time is dropped, as
switches do.
"""

from __future__ import annotations

from collections import deque
from time import monotonic_ns

from devicebus.mailbox.eoe import MAX_FRAME, FrameAssembler
from devicebus.mailbox.eoe_switch import send_frame
from devicebus.master.mailboxes import Unsolicited
from eap.ads.notifications import AdsClient
from eap.ads.request import AdsRefusedError, Read, ReadWrite, Write
from eap.codec.ads import AdsError
from eap.codec.eoe import (
    COUNT_SIZE,
    REQUESTS,
    EoeHeader,
    EoeType,
    encode_counted,
    encode_message,
)
from eap.codec.mailbox import MailboxType
from eap.errors import CodecError
from eap.ids import NetId
from eap.services.slaves.access import LocalSlave
from eap.services.slaves.bus_client import BusClient

READER_NS = 60_000_000_000
"""For how long after it has fetched frames a client gets the next ones."""
NUMBER_SIZE = 4
MAX_READERS = 8
"""Of one slave; a new one replaces the one that was silent longest."""
MAX_QUEUED = 64
"""Frames that wait for one reader."""
_SHORTEST_READ = COUNT_SIZE + MAX_FRAME


class _FrameQueue:
    __slots__ = ("frames", "until_ns")

    def __init__(self) -> None:
        self.frames: deque[bytes] = deque(maxlen=MAX_QUEUED)
        self.until_ns = 0


class SlaveEthernet:
    """EoE of the slaves on one bus, for ADS clients.

    Args:
        bus: With the slaves.
    """

    def __init__(self, bus: BusClient) -> None:
        self._bus = bus
        self._readers: dict[int, dict[tuple[NetId, bytes], _FrameQueue]] = {}
        self._assemblers: dict[int, FrameAssembler] = {}
        self._numbers: dict[int, int] = {}
        bus.listen(self._receive)

    async def perform(
        self,
        access: LocalSlave,
        station: int,
        client: AdsClient,
        operation: Read | Write | ReadWrite,
    ) -> bytes:
        """Send a frame, return frames, or exchange settings.

        Raises:
            AdsRefusedError: the operation is wrong.
            EapError: the slave does not do it, as a SlaveAccess says.
        """
        match operation:
            case Read():
                raise AdsRefusedError(AdsError.SERVICE, "frames are fetched by ReadWrite")
            case Write():
                await self._send(access, station, operation.data)
                return b""
            case ReadWrite(_, EoeType.FRAGMENT, length, number):
                if len(number) != NUMBER_SIZE:
                    why = f"a number of {len(number)} bytes, expected {NUMBER_SIZE}"
                    raise AdsRefusedError(AdsError.SIZE, why)
                return self._fetch(station, (client.net_id, number), length)
        if operation.offset not in REQUESTS:
            raise AdsRefusedError(AdsError.INDEX_OFFSET, f"{operation.offset} is no request of EoE")
        request = encode_message(EoeType(operation.offset), operation.data)
        return (await access.exchange(MailboxType.EOE, request)).data

    async def _send(self, access: LocalSlave, station: int, frame: bytes) -> None:
        number = self._numbers.get(station, 0)
        self._numbers[station] = (number + 1) % 16
        sizes = await access.sizes()
        try:
            await self._bus.converse(station, send_frame(frame, number, sizes), self)
        except CodecError as exc:
            raise AdsRefusedError(AdsError.SIZE, str(exc)) from None

    def _fetch(self, station: int, key: tuple[NetId, bytes], length: int) -> bytes:
        if length < _SHORTEST_READ:
            why = f"room for {length} bytes, expected at least {_SHORTEST_READ}"
            raise AdsRefusedError(AdsError.SIZE, why)
        readers = self._readers.setdefault(station, {})
        # Behind the others, so that the first one was silent longest.
        reader = readers.pop(key) if key in readers else _FrameQueue()
        readers[key] = reader
        reader.until_ns = monotonic_ns() + READER_NS
        if len(readers) > MAX_READERS:
            del readers[next(iter(readers))]
        found = b""
        while reader.frames and len(found) + COUNT_SIZE + len(reader.frames[0]) <= length:
            frame = reader.frames.popleft()
            found += encode_counted(frame)
        return found

    def _receive(self, message: Unsolicited) -> None:
        """Take a fragment of a slave's frame, if there is a reader."""
        readers = self._readers.get(message.station)
        if not readers or message.type is not MailboxType.EOE:
            return
        now_ns = monotonic_ns()
        for key in [key for key, each in readers.items() if each.until_ns <= now_ns]:
            del readers[key]
        if not readers:
            self._assemblers.pop(message.station, None)
            return
        assembler = self._assemblers.setdefault(message.station, FrameAssembler())
        try:
            if EoeHeader.decode(message.data).type is not EoeType.FRAGMENT:
                return
            frame = assembler.receive(message.data)
        except CodecError:
            return  # the slave's message; its counters are those of the mailbox
        if frame is not None:
            for reader in readers.values():
                reader.frames.append(frame)
