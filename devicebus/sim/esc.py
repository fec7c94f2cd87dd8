"""EtherCAT slave controller (ESC): registers, memory, and the effects of accesses to them.

Datagrams use *read* and *write*, whose result decides the working counter.  The slave's application
uses the sync managers and :meth:`Esc.set_al_status`, and reads *al_event*.  A datagram counts as
executed when at least one of its bytes was read or written: a write to FMMU 6 of an ESC without
FMMU 6 leaves the working counter unchanged.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple

import msgspec

from devicebus.sim.clock import Clock
from devicebus.sim.eeprom import Eeprom
from devicebus.sim.fmmu import FmmuWindow, active_windows
from devicebus.sim.syncmanager import SyncChannel, Watchdog
from devicebus.wire.alstatus import AlState
from devicebus.wire.register import AlEvent, Register

REGISTERS = int(Register.MEMORY)
"""Size of the register space in bytes."""

_READ = (
    (0x0000, 0x000A), (0x0010, 0x0014), (0x0020, 0x0022), (0x0030, 0x0032), (0x0040, 0x0041),
    (0x0100, 0x0104), (0x0108, 0x010A), (0x0110, 0x0112), (0x0120, 0x0122), (0x0130, 0x0136),
    (0x0140, 0x0142), (0x0150, 0x0154), (0x0200, 0x0202), (0x0204, 0x0208), (0x0210, 0x0212),
    (0x0220, 0x0224), (0x0300, 0x0314), (0x0400, 0x0402), (0x0410, 0x0412), (0x0420, 0x0422),
    (0x0440, 0x0444), (0x0500, 0x0510),
)  # fmt: skip
_WRITE = (
    (0x0010, 0x0012), (0x0020, 0x0022), (0x0030, 0x0032), (0x0040, 0x0041), (0x0100, 0x0104),
    (0x0120, 0x0122), (0x0200, 0x0202), (0x0300, 0x030E), (0x0310, 0x0314), (0x0400, 0x0402),
    (0x0410, 0x0412), (0x0420, 0x0422), (0x0442, 0x0444), (0x0500, 0x0501), (0x0502, 0x0510),
)  # fmt: skip
_READ_DC = (
    (0x0900, 0x0936), (0x0980, 0x0983), (0x0984, 0x0985), (0x098E, 0x09A8),
)  # fmt: skip
_WRITE_DC = (
    (0x0900, 0x0904), (0x0910, 0x0918), (0x0920, 0x092C), (0x0930, 0x0932), (0x0934, 0x0936),
    (0x0980, 0x0982), (0x0990, 0x0998), (0x09A0, 0x09A8),
)  # fmt: skip


class AccessMap(NamedTuple):
    """Access rights: one byte per register byte, 1 if readable or writable."""

    readable: bytes
    writable: bytes


def access_map(fmmus: int, sync_managers: int, *, has_dc: bool) -> AccessMap:
    """Return the master's access rights of an ESC with so many FMMUs and sync managers."""
    channels = range(Register.SYNC_MANAGER, Register.SYNC_MANAGER + 8 * sync_managers, 8)
    units = range(Register.FMMU, Register.FMMU + 16 * fmmus, 16)
    read = [*_READ, *((at, at + 16) for at in units), *((at, at + 8) for at in channels)]
    write = [
        *_WRITE,
        *((at, at + 13) for at in units),
        *_writable_of_channels(channels),
    ]
    if has_dc:
        read += _READ_DC
        write += _WRITE_DC
    return AccessMap(_mark(read), _mark(write))


def _writable_of_channels(channels: Iterable[int]) -> Iterator[tuple[int, int]]:
    # The status byte (offset 5) and PDI control (offset 7) are writable by the slave only.
    for at in channels:
        yield at, at + 5
        yield at + 6, at + 7


def _mark(ranges: Iterable[tuple[int, int]]) -> bytes:
    marks = bytearray(REGISTERS)
    for start, end in ranges:
        marks[start:end] = b"\1" * (end - start)
    return bytes(marks)


PORTS = 4
_YES = b"\1"
_EVENT_DL, _EVENT_AL = 0x0004, 0x0008
_DEVICE_EMULATION = 0x01
_DIGITAL_OUTPUTS = 0x0F00
"""Output registers of controllers with digital I/O, which a sync manager may guard."""


class EscSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Type and features of a controller; the defaults are those of a common one."""

    type: int = 0x11
    revision: int = 0
    build: int = 2
    fmmus: int = 8
    sync_managers: int = 16
    ram: int = 8192
    """Size of the process data memory in bytes."""
    port_descriptor: int = 0x0F
    """Two bits per port: 0 none, 1 not configured, 2 E-bus, 3 MII."""
    has_dc: bool = True
    drift_ppm: float = 0.0
    local_start_ns: int = 0
    """Local time of its clock at power-on."""


class Esc:
    """Controller with its EEPROM *image*.

    Attributes:
        al_event: Bits of the AL event register that the application has not handled yet.
        ecat_event: Bits of the ECAT event register, for the master.
        loops_changed: True after a write to the loop control of the ports, until the wiring is
            updated.
        event_mask: ECAT events that go into the event field of datagrams.
        windows: Active FMMUs.
        port_delays: Time from a frame's entry into the segment to its arrival at each port; None
            for a port without arrival; set by the wiring.
        processing_delay: Time from a frame's entry to its processing here; set by the wiring.
    """

    def __init__(self, image: bytes, settings: EscSettings | None = None) -> None:
        self.settings = settings or EscSettings()
        self._image = bytearray(image)
        self.power_on()

    @property
    def image(self) -> bytes:
        """EEPROM image."""
        return bytes(self._image)

    @image.setter
    def image(self, image: bytes) -> None:
        self._image[:] = image

    def power_on(self) -> None:
        """Reset registers and memory; the EEPROM keeps its content."""
        given = self.settings
        self.memory = bytearray(REGISTERS + given.ram)
        self._readable, self._writable = access_map(
            given.fmmus, given.sync_managers, has_dc=given.has_dc
        )
        self.al_event = 0
        self.ecat_event = 0
        self.event_mask = 0
        self.loops_changed = False
        self.port_delays: tuple[int | None, ...] = (0,) + (None,) * (PORTS - 1)
        self.processing_delay = 0
        self._describe()
        self.eeprom = Eeprom(self.memory, self._image)
        self.clock = Clock(
            self.memory, drift_ppm=given.drift_ppm, local_start_ns=given.local_start_ns
        )
        self.watchdog = Watchdog(self.memory)
        self.channels = tuple(SyncChannel(self.memory, n) for n in range(given.sync_managers))
        self._guards: tuple[SyncChannel, ...] = ()
        self._areas: dict[tuple[int, int], SyncChannel] = {}
        self.windows: tuple[FmmuWindow, ...] = ()
        self._data_start = REGISTERS
        self.set_al_status(AlState.INIT, 0)
        # INIT at power-on is no change that the master has to learn.
        self.ecat_event = 0

    def _describe(self) -> None:
        given, memory = self.settings, self.memory
        memory[0:2] = bytes((given.type, given.revision))
        memory[2:4] = given.build.to_bytes(2, "little")
        memory[4:8] = bytes(
            (given.fmmus, given.sync_managers, given.ram // 1024, given.port_descriptor)
        )
        # Features: bit 2 distributed clocks, bit 3 with 64 bits.
        memory[Register.FEATURES] = 0x0C if given.has_dc else 0
        memory[Register.DL_CONTROL] = 1

    @property
    def station(self) -> int:
        """Configured station address."""
        return self._word(Register.STATION_ADDRESS)

    @property
    def alias(self) -> int | None:
        """Station alias, None unless DL control enables it."""
        enabled = self.memory[Register.DL_CONTROL + 3] & 1
        return self._word(Register.STATION_ALIAS) if enabled else None

    @property
    def emulates_device(self) -> bool:
        """True in device emulation: AL status mirrors AL control without an application."""
        return bool(self.memory[Register.ESC_CONFIGURATION] & _DEVICE_EMULATION)

    @property
    def irq(self) -> int:
        """Bits that this controller ORs into the event field of every datagram."""
        return self.event_mask & self._events()

    def loop_control(self, port: int) -> int:
        """Return the loop control of a port: 0 auto, 1 auto close, 2 open, 3 closed."""
        return self.memory[Register.DL_CONTROL + 1] >> 2 * port & 3

    def set_dl_status(self, status: int) -> None:
        """Set DL status; a change is an event, a lost link is counted."""
        at = Register.DL_STATUS
        old = self._word(at)
        if status == old:
            return
        self.memory[at : at + 2] = status.to_bytes(2, "little")
        self.ecat_event |= _EVENT_DL
        for port in range(PORTS):
            if (old & ~status) >> 4 + port & 1:
                self.count_error(Register.LOST_LINK + port)

    def count_error(self, counter: int) -> None:
        """Increment an error counter; it stops at 255."""
        self.memory[counter] = min(self.memory[counter] + 1, 0xFF)

    def set_al_status(self, status: int, code: int) -> None:
        """Set AL status with its error bit, and the AL status code."""
        at = Register.AL_STATUS
        octets = status.to_bytes(2, "little") + bytes(2) + code.to_bytes(2, "little")
        if self.memory[at : at + 6] != octets:
            self.memory[at : at + 6] = octets
            self.ecat_event |= _EVENT_AL

    def read(self, address: int, length: int, now_ns: int) -> bytes | None:
        """Return the data of a master's read, None if no byte exists or is readable now."""
        end = address + length
        first = self._data_start
        if address >= first:
            return self._read_memory(address, end)
        if end > first:
            return self._join(
                (first - address, self.read(address, first - address, now_ns)),
                (end - first, self._read_memory(first, end)),
            )
        # An access to unimplemented registers only leaves the working counter unchanged.
        if _YES not in self._readable[address:end]:
            return None
        for page in range(address >> 8, (end - 1 >> 8) + 1):
            if page in _FRESH:
                self._refresh(page, now_ns)
        data = bytes(self.memory[address:end])
        # Reading the register acknowledges its ECAT event.
        if address <= Register.AL_STATUS < end:
            self.ecat_event &= ~_EVENT_AL
        if address <= Register.DL_STATUS < end:
            self.ecat_event &= ~_EVENT_DL
        return data

    def write(self, address: int, data: bytes, now_ns: int) -> bool:
        """Execute a master's write; return false if no byte was written."""
        end = address + len(data)
        first = self._data_start
        if address >= first:
            return self._write_memory(address, data, now_ns)
        if end > first:
            first_size = first - address
            done = self.write(address, data[:first_size], now_ns)
            return self._write_memory(first, data[first_size:], now_ns) or done
        marks = self._writable[address:end]
        if address < _EEPROM_END and end > _EEPROM and not self._takes_eeprom(now_ns):
            return False
        if _YES not in marks:
            return False
        old = bytes(self.memory[address:end])
        if b"\0" in marks:
            data = bytes(
                new if mark else was for new, was, mark in zip(data, old, marks, strict=True)
            )
        self.memory[address:end] = data
        for page in range(address >> 8, (end - 1 >> 8) + 1):
            self._written(page, address, end, now_ns)
        return True

    def peek(self, address: int, length: int) -> bytes:
        """Return bytes without the effects of a read."""
        return bytes(self.memory[address : address + length])

    def _refresh(self, page: int, now_ns: int) -> None:
        memory = self.memory
        if page == 0x09:
            # The time is that of the frame's entry into the segment: it reaches this slave later.
            self.clock.refresh(now_ns + self.processing_delay)
            return
        if page == 0x05:
            self.eeprom.finish_command(now_ns)
            return
        at = Register.ECAT_EVENT
        memory[at : at + 2] = self._events().to_bytes(2, "little")
        at = Register.AL_EVENT
        memory[at : at + 4] = self.al_event.to_bytes(4, "little")

    def _takes_eeprom(self, now_ns: int) -> bool:
        self.eeprom.finish_command(now_ns)
        return self.eeprom.is_with_master and self.eeprom.busy_until_ns is None

    def _events(self) -> int:
        # The register has event bits for sync managers 0 to 7 only.
        full = sum(1 << 4 + n for n, each in enumerate(self.channels[:8]) if each.is_full)
        return self.ecat_event | full

    def _written(self, page: int, start: int, end: int, now_ns: int) -> None:
        match page:
            case 0x01:
                self.loops_changed |= start <= Register.DL_CONTROL + 1 < end
                if start <= Register.AL_CONTROL < end:
                    self.al_event |= AlEvent.AL_CONTROL
            case 0x02:
                self.event_mask = self._word(Register.ECAT_EVENT_MASK)
            case 0x03:
                self._clear_counters(start, end)
            case 0x04:
                self._clear_counters(start, end)
                self.watchdog.configure()
            case 0x05:
                self._eeprom_written(start, end, now_ns)
            case 0x06:
                self.windows = active_windows(self.memory, self.settings.fmmus)
            case 0x08:
                self._sync_managers_written(start, end)
            case 0x09:
                self._clock_written(start, end, now_ns)

    def _eeprom_written(self, start: int, end: int, now_ns: int) -> None:
        if start <= Register.EEPROM_CONFIGURATION < end:
            self.eeprom.ownership_written()
        if start <= Register.EEPROM_CONTROL < end:
            self.eeprom.control_written(now_ns)

    def _sync_managers_written(self, start: int, end: int) -> None:
        for number, channel in enumerate(self.channels):
            at = Register.SYNC_MANAGER + 8 * number
            if start < at + 8 and end > at and (channel.configure() or start <= at + 6 < end):
                self.al_event |= AlEvent.SM_ACTIVATION
        self._guards = tuple(channel for channel in self.channels if channel.is_enabled)
        self._areas = _find_areas(self._guards)
        starts = (each.start for each in self._guards if each.start >= _DIGITAL_OUTPUTS)
        self._data_start = min((REGISTERS, *starts))

    def _clear_counters(self, start: int, end: int) -> None:
        # Any write clears the whole group of counters, whatever its data.
        groups = (
            (Register.RX_ERROR, Register.PROCESSING_UNIT_ERROR),
            (Register.PROCESSING_UNIT_ERROR, Register.PROCESSING_UNIT_ERROR + 1),
            (Register.PDI_ERROR, Register.PDI_ERROR + 1),
            (Register.LOST_LINK, Register.LOST_LINK + 4),
            (Register.WATCHDOG_COUNTER, Register.WATCHDOG_COUNTER + 2),
        )
        for first, last in groups:
            if start < last and end > first:
                self.memory[first:last] = bytes(last - first)

    def _clock_written(self, start: int, end: int, now_ns: int) -> None:
        # A write to the receive time of port 0 latches all ports.
        if start <= Register.DC_RECEIVE_TIME < end:
            self.clock.latch(now_ns, self.port_delays, self.processing_delay)
        if start <= Register.DC_SYSTEM_TIME < end:
            entry = now_ns + self.processing_delay
            last = min(end, Register.DC_SYSTEM_TIME + 8)
            self.clock.steer(bytes(self.memory[Register.DC_SYSTEM_TIME : last]), entry)
        if start < Register.DC_SYSTEM_TIME_FILTER + 2 and end > Register.DC_SYSTEM_TIME_OFFSET:
            self.clock.restart_loop()
        if start <= Register.DC_ACTIVATION < end:
            self.clock.activate(now_ns)

    def _read_memory(self, start: int, end: int) -> bytes | None:
        # Almost every access is one whole sync manager area: one look-up instead of a search.
        channel = self._areas.get((start, end))
        if channel is not None:
            return self._read_guarded(channel, start, end)
        for channel in self._guards:
            if start < channel.end and end > channel.start:
                if start < channel.start or end > channel.end:
                    return self._read_across(start, end)
                return self._read_guarded(channel, start, end)
        # A read partly behind the memory's end counts, one wholly behind it does not.
        data = bytes(self.memory[start:end])
        return data.ljust(end - start, b"\0") if data else None

    def _read_guarded(self, channel: SyncChannel, start: int, end: int) -> bytes | None:
        event = channel.read_by_master(start, end)
        if event < 0:
            return None
        self.al_event |= event
        return bytes(self.memory[start:end])

    def _read_across(self, start: int, end: int) -> bytes | None:
        return self._join(
            *((last - at, self._read_memory(at, last)) for at, last in self._split(start, end))
        )

    @staticmethod
    def _join(*parts: tuple[int, bytes | None]) -> bytes | None:
        if all(octets is None for _, octets in parts):
            return None
        return b"".join(bytes(size) if octets is None else octets for size, octets in parts)

    def _write_memory(self, start: int, data: bytes, now_ns: int) -> bool:
        end = start + len(data)
        channel = self._areas.get((start, end))
        if channel is not None:
            return self._write_guarded(channel, start, data, now_ns)
        for channel in self._guards:
            if start < channel.end and end > channel.start:
                if start < channel.start or end > channel.end:
                    parts = self._split(start, end)
                    done = [
                        self._write_memory(at, data[at - start : last - start], now_ns)
                        for at, last in parts
                    ]
                    return any(done)
                return self._write_guarded(channel, start, data, now_ns)
        if start >= len(self.memory):
            return False
        first_size = len(self.memory) - start
        self.memory[start : start + min(first_size, len(data))] = data[:first_size]
        return True

    def _write_guarded(self, channel: SyncChannel, start: int, data: bytes, now_ns: int) -> bool:
        event = channel.write_by_master(start, data)
        if event > 0:
            self.al_event |= event
            if channel.watches:
                self.watchdog.feed(now_ns)
        return event >= 0

    def _split(self, start: int, end: int) -> list[tuple[int, int]]:
        edges = {start, end}
        for channel in self._guards:
            edges |= {edge for edge in (channel.start, channel.end) if start < edge < end}
        return list(pairwise(sorted(edges)))

    def _word(self, at: int) -> int:
        return self.memory[at] | self.memory[at + 1] << 8


def _find_areas(guards: tuple[SyncChannel, ...]) -> dict[tuple[int, int], SyncChannel]:
    """Return the sync managers by area, without overlapping ones."""
    return {
        (each.start, each.end): each
        for each in guards
        if all(
            other is each or other.end <= each.start or each.end <= other.start for other in guards
        )
    }


_FRESH = frozenset((0x02, 0x05, 0x09))
_EEPROM, _EEPROM_END = int(Register.EEPROM_CONTROL), int(Register.EEPROM_DATA) + 8
