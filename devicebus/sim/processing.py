"""Processing of a frame's datagrams by the controllers on its path (ETG.1000.4).

The order is datagram by datagram instead of slave by slave.  The result is the same, and a datagram
for one slave costs nothing at the others.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from operator import attrgetter
from typing import NamedTuple

from devicebus.sim.esc import Esc
from devicebus.sim.fmmu import (
    FmmuSlice,
    FmmuWindow,
    find_slices,
    insert_slices,
    read_slices,
    write_slices,
)
from devicebus.wire.datagram import OVERHEAD, Command
from devicebus.wire.register import Register
from eap.codec.ethercat import EtherCatHeader, FrameType

_HEADER = struct.Struct("<BBHHHH")
_SIZE = _HEADER.size
_MORE, _CIRCULATING, _LENGTH = 0x8000, 0x4000, 0x07FF
_ADDRESS_END = Register.DL_CONTROL + 4
# Ends of the registers of station addresses, and of the ECAT event mask.
_MASK_END = Register.ECAT_EVENT_MASK + 2
_READS = frozenset((Command.APRD, Command.FPRD, Command.BRD, Command.APRW, Command.FPRW,
                    Command.BRW))  # fmt: skip
_WRITES = frozenset((Command.APWR, Command.FPWR, Command.BWR, Command.APRW, Command.FPRW,
                     Command.BRW))  # fmt: skip
_BY_POSITION = frozenset((Command.APRD, Command.APWR, Command.APRW, Command.ARMW))
_BROADCAST = frozenset((Command.BRD, Command.BWR, Command.BRW))
_MULTIPLE = frozenset((Command.ARMW, Command.FRMW))
_LOGICAL_WRITES: dict[int, int] = {Command.LWR: 1, Command.LRW: 2}
_LOGICAL = frozenset((Command.LRD, *_LOGICAL_WRITES))
_NOP, _LAST, _LWR = int(Command.NOP), int(Command.FRMW), int(Command.LWR)
_CAN_READ, _CAN_WRITE = attrgetter("can_read"), attrgetter("can_write")
# Limit for cached plans, for a master that sends other logical addresses in every frame.
_MAX_PLANS = 64


class _LogicalAccess(NamedTuple):
    """Part of a logical datagram that one controller reads and writes."""

    esc: Esc
    reads: tuple[FmmuSlice, ...]
    writes: tuple[FmmuSlice, ...]


class Chain:
    """Controllers on the path of frames from one end, in the order of the frame.

    Args:
        escs: Controllers in the order of the frame.
        closed_at: Index of the first one without a link at port 0, which sets the circulating bit
            and destroys frames that have it already.
    """

    def __init__(self, escs: Sequence[Esc], *, closed_at: int | None = None) -> None:
        self._escs = tuple(escs)
        self._closed_at = closed_at
        self._stations: dict[int, list[Esc]] | None = None
        self._masked: list[Esc] | None = None
        self._plans: dict[tuple[int, int], tuple[_LogicalAccess, ...]] = {}
        self._planned: list[tuple[FmmuWindow, ...]] = []

    def process(self, frame: bytearray, now_ns: int) -> bool:
        """Process *frame* in place; return False if a controller destroys it as circulating."""
        if len(frame) < EtherCatHeader.SIZE:
            return True
        word = frame[0] | frame[1] << 8
        if word >> 12 != FrameType.DATAGRAM:
            return True
        end = min(EtherCatHeader.SIZE + (word & _LENGTH), len(frame))
        offset = EtherCatHeader.SIZE
        while offset + OVERHEAD <= end:
            command, _, adp, ado, flags, _ = _HEADER.unpack_from(frame, offset)
            length = flags & _LENGTH
            if offset + OVERHEAD + length > end:
                break
            if self._closed_at is not None:
                # A frame that passes this controller twice would circulate for ever.
                if flags & _CIRCULATING:
                    return False
                flags |= _CIRCULATING
                frame[offset + 6 : offset + 8] = flags.to_bytes(2, "little")
            self._datagram(frame, offset, command, (adp, ado, length), now_ns)
            if not flags & _MORE:
                break
            offset += OVERHEAD + length
        return True

    def _datagram(
        self, frame: bytearray, offset: int, command: int, where: tuple[int, int, int], now_ns: int
    ) -> None:
        adp, ado, length = where
        start = offset + _SIZE
        end = start + length
        if command in _LOGICAL:
            count = self._logical(frame, start, command, (ado << 16 | adp, length), now_ns)
        else:
            data = frame[start:end]
            if command in _MULTIPLE:
                count = self._read_multiple_write(command, adp, ado, data, now_ns)
            elif command == _NOP or command > _LAST:
                count = 0
            else:
                count = self._access(command, self._addressed(command, adp), ado, data, now_ns)
            if command in _BY_POSITION or command in _BROADCAST:
                # Every slave on the way increments ADP, whether it acts or not.
                struct.pack_into("<H", frame, offset + 2, (adp + len(self._escs)) & 0xFFFF)
            if count:
                frame[start:end] = data
                # Station addresses or event masks may have changed: the caches of both are rebuilt.
                if ado < _MASK_END and (command in _WRITES or command in _MULTIPLE):
                    self._masked = None
                    if ado < _ADDRESS_END:
                        self._stations = None
        self._add_irq(frame, offset + 8)
        if count:
            wkc = (frame[end] | frame[end + 1] << 8) + count
            frame[end : end + 2] = (wkc & 0xFFFF).to_bytes(2, "little")

    def _addressed(self, command: int, adp: int) -> Sequence[Esc]:
        if command in _BROADCAST:
            return self._escs
        if command in _BY_POSITION:
            position = -adp & 0xFFFF
            return self._escs[position : position + 1]
        if self._stations is None:
            self._stations = {}
            for esc in self._escs:
                for address in {esc.station, esc.alias}:
                    if address is not None:
                        self._stations.setdefault(address, []).append(esc)
        return self._stations.get(adp, ())

    @staticmethod
    def _access(command: int, escs: Sequence[Esc], ado: int, data: bytearray, now_ns: int) -> int:
        count = 0
        reads, writes = command in _READS, command in _WRITES
        for esc in escs:
            sent = bytes(data)
            octets = esc.read(ado, len(sent), now_ns) if reads else None
            # APRW, FPRW and BRW write the received data and return the old content.
            if writes and esc.write(ado, sent, now_ns):
                count += 2 if reads else 1  # a write counts 2 in commands that also read
            if octets is not None:
                count += 1
                if command in _BROADCAST:
                    joined = int.from_bytes(sent, "little") | int.from_bytes(octets, "little")
                    octets = joined.to_bytes(len(sent), "little")
                data[:] = octets
        return count

    def _read_multiple_write(
        self, command: int, adp: int, ado: int, data: bytearray, now_ns: int
    ) -> int:
        """Execute ARMW or FRMW: the addressed controller is read, the others are written."""
        count = 0
        readers = self._addressed(Command.FPRD if command == Command.FRMW else command, adp)
        for esc in self._escs:
            if esc in readers:
                octets = esc.read(ado, len(data), now_ns)
                if octets is not None:
                    data[:] = octets
                    count += 1
            elif esc.write(ado, bytes(data), now_ns):
                count += 1
        return count

    def _logical(
        self, frame: bytearray, start: int, command: int, where: tuple[int, int], now_ns: int
    ) -> int:
        count = 0
        writing = _LOGICAL_WRITES.get(command, 0)
        reading = command != _LWR
        for esc, reads, writes in self._plan(where):
            found = read_slices(esc, reads, now_ns) if reading and reads else None
            if writing and writes and write_slices(esc, writes, frame, start, now_ns):
                count += writing
            if found:
                count += 1
                insert_slices(frame, start, found)
        return count

    def _plan(self, where: tuple[int, int]) -> tuple[_LogicalAccess, ...]:
        """Return the accesses of a logical datagram by address and length, cached."""
        windows = [esc.windows for esc in self._escs]
        if windows != self._planned or len(self._plans) >= _MAX_PLANS:
            self._plans.clear()
            self._planned = windows
        plan = self._plans.get(where)
        if plan is None:
            accesses = (_logical_access(esc, *where) for esc in self._escs if esc.windows)
            plan = self._plans[where] = tuple(each for each in accesses if each is not None)
        return plan

    def _add_irq(self, frame: bytearray, at: int) -> None:
        if self._masked is None:
            self._masked = [esc for esc in self._escs if esc.event_mask]
        irq = 0
        for esc in self._masked:
            irq |= esc.irq
        if irq:
            frame[at] |= irq & 0xFF
            frame[at + 1] |= irq >> 8


def _logical_access(esc: Esc, address: int, size: int) -> _LogicalAccess | None:
    reads, writes = (
        find_slices((window for window in esc.windows if chosen(window)), address, size)
        for chosen in (_CAN_READ, _CAN_WRITE)
    )
    return _LogicalAccess(esc, reads, writes) if reads or writes else None
