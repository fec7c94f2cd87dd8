"""Sync manager channel: guarded access to its memory area, and the process data watchdog.

ETG.1000.4: in both modes an access begins with the first byte and is complete with the last.  A
mailbox then belongs to the other side.  A buffered area has three buffers, so that neither side
waits or reads a partial write.
"""

from __future__ import annotations

from devicebus.wire.register import Register, SmStatus

_BUFFERED_EMPTY = 0x30
_WRITTEN, _READ, _FULL = map(int, SmStatus)
# Next value of status bits 4 and 5 by the present one; 3 is before the first buffer.
_NEXT_BUFFER = (0x10, 0x20, 0x00, 0x00)
_ACTIVATE, _STATUS, _PDI_CONTROL = 6, 5, 7


class SyncChannel:
    """Sync manager *number* in the memory of an ESC.

    Attributes:
        start, end: Memory area.
        is_enabled: True if it guards the area.
        is_mailbox: True for mailbox mode, false for three buffers.
        master_writes: True if the master writes the area.
        watches: True if writes trigger the process data watchdog.
        is_stuck: Fault: data written by the master is never read.
    """

    __slots__ = ("_buffer", "_dirty", "_memory", "_open", "_register", "_setting", "_status_at",
                 "_waiting", "end", "event", "is_enabled", "is_mailbox", "is_stuck",
                 "master_writes", "start", "watches")  # fmt: skip

    def __init__(self, memory: bytearray, number: int) -> None:
        self._memory = memory
        self._register = Register.SYNC_MANAGER + 8 * number
        self._status_at = self._register + _STATUS
        self.event = 0x100 << number
        self.is_stuck = False
        self._setting: bytes | None = None
        self.configure()

    def configure(self) -> bool:
        """Load the registers; return true if anything but the repeat bit has changed."""
        at = self._register
        octets = self._memory[at : at + 8]
        setting = bytes((*octets[:5], octets[_ACTIVATE] & 1, octets[_PDI_CONTROL] & 1))
        # A toggle of the repeat bit must not empty the mailbox.
        if setting == self._setting:
            return False
        self._setting = setting
        self.start = int.from_bytes(octets[0:2], "little")
        length = int.from_bytes(octets[2:4], "little")
        self.end = min(self.start + length, len(self._memory))
        control = octets[4]
        self.is_mailbox = control & 3 == 2
        self.master_writes = control >> 2 & 3 == 1
        self.watches = bool(control & 0x40)
        self.is_enabled = bool(octets[_ACTIVATE] & 1) and self.start < self.end
        self._open = False
        self._dirty = False
        self._waiting: bytes | None = None
        self._buffer = bytes(self.end - self.start) if self.is_enabled else b""
        buffered = self.is_enabled and not self.is_mailbox
        self._set_status(_BUFFERED_EMPTY if buffered else 0)
        return True

    @property
    def length(self) -> int:
        """Length of the area in bytes, 0 while disabled."""
        return self.end - self.start if self.is_enabled else 0

    @property
    def is_full(self) -> bool:
        """True if the mailbox holds a message."""
        return bool(self._memory[self._status_at] & _FULL)

    @property
    def is_locked(self) -> bool:
        """True if the slave has deactivated the channel."""
        return bool(self._memory[self._register + _PDI_CONTROL] & 1)

    @property
    def repeat_request(self) -> int:
        """Repeat request bit, toggled by the master (activate, bit 1)."""
        return self._memory[self._register + _ACTIVATE] >> 1 & 1

    @property
    def repeat_acknowledge(self) -> int:
        """Repeat acknowledge bit of the slave (PDI control, bit 1)."""
        return self._memory[self._register + _PDI_CONTROL] >> 1 & 1

    def acknowledge_repeat(self) -> None:
        """Copy the repeat request to the acknowledgement."""
        at = self._register + _PDI_CONTROL
        self._memory[at] = self._memory[at] & ~2 | self.repeat_request << 1

    def read_by_master(self, start: int, end: int) -> int:
        """Prepare a master's read of part of the area.

        Returns:
            -1 if it is refused, else the AL event that it causes, or 0.
        """
        # A refused access leaves the working counter at 0: by that the master polls an empty
        # mailbox.
        if self.master_writes or self.is_locked or (self.is_mailbox and not self.is_full):
            return -1
        # The first byte opens the buffer: until the last byte is read it must not change.
        if start == self.start:
            self._open = True
            if self._waiting is not None:
                self._memory[self.start : self.end] = self._waiting
                self._waiting = None
        elif not self._open:
            return -1
        if end < self.end:
            return 0
        self._open = False
        self._set_status(
            _READ if self.is_mailbox else self._memory[self._status_at] & ~_WRITTEN | _READ
        )
        return self.event

    def write_by_master(self, start: int, data: bytes) -> int:
        """Write part of the area for a master.

        Returns:
            -1 if it is refused, else the AL event that it causes, or 0.
        """
        # A full mailbox refuses further writes until the slave has read its last byte.
        if not self.master_writes or self.is_locked or (self.is_mailbox and self.is_full):
            return -1
        if start == self.start:
            self._open = True
        elif not self._open:
            return -1
        end = start + len(data)
        self._memory[start:end] = data
        if end < self.end:
            return 0
        self._open = False
        self._dirty = True
        if self.is_mailbox:
            self._set_status(_FULL | _WRITTEN)
        else:
            self._buffer = bytes(self._memory[self.start : self.end])
            self._next_buffer()
        return self.event

    def take(self) -> bytes | None:
        """Return data that the master wrote since the last call, None without a complete write."""
        if not self._dirty or self.is_stuck:
            return None
        self._dirty = False
        if not self.is_mailbox:
            # The last complete write, not the memory: the master may be halfway through the next.
            return self._buffer
        self._set_status(_READ)
        return bytes(self._memory[self.start : self.end])

    def put(self, data: bytes) -> bool:
        """Provide *data* for the master; return False while a mailbox is still full."""
        octets = data.ljust(self.length, b"\0")[: self.length]
        if self.is_mailbox:
            if self.is_full:
                return False
            self._memory[self.start : self.end] = octets
            self._set_status(_FULL | _WRITTEN)
            return True
        # While the master reads, the new data waits in the third buffer.
        if self._open:
            self._waiting = octets
        else:
            self._memory[self.start : self.end] = octets
        self._next_buffer()
        return True

    def discard(self) -> None:
        """Empty a mailbox."""
        self._dirty = False
        self._set_status(0)

    def _set_status(self, status: int) -> None:
        self._memory[self._status_at] = status

    def _next_buffer(self) -> None:
        buffer = self._memory[self._status_at] >> 4 & 3
        self._memory[self._status_at] = _NEXT_BUFFER[buffer] | _WRITTEN


_WATCHDOG_STATUS = int(Register.WATCHDOG_STATUS)
# The watchdog divider counts periods of 25 MHz.
_TICK_NS = 40


class Watchdog:
    """Process data watchdog, triggered by every complete write to a watched sync manager.

    Attributes:
        deadline_ns: Time of its expiry; None before the first trigger or while it is disabled.
        timeout_ns: Watchdog time; 0 disables the watchdog.
    """

    __slots__ = ("_memory", "deadline_ns", "timeout_ns")

    def __init__(self, memory: bytearray) -> None:
        self._memory = memory
        self.deadline_ns: int | None = None
        memory[Register.WATCHDOG_DIVIDER : Register.WATCHDOG_DIVIDER + 2] = b"\xc2\x09"
        for at in (Register.WATCHDOG_PDI, Register.WATCHDOG_PROCESS_DATA):
            memory[at : at + 2] = b"\xe8\x03"
        memory[_WATCHDOG_STATUS] = 1
        self.configure()

    def configure(self) -> None:
        """Load the registers."""
        at, memory = Register.WATCHDOG_DIVIDER, self._memory
        divider = int.from_bytes(memory[at : at + 2], "little") + 2
        at = Register.WATCHDOG_PROCESS_DATA
        self.timeout_ns = divider * _TICK_NS * int.from_bytes(memory[at : at + 2], "little")

    def feed(self, now_ns: int) -> None:
        """Restart the watchdog: outputs were written."""
        self.deadline_ns = now_ns + self.timeout_ns if self.timeout_ns else None
        self._memory[_WATCHDOG_STATUS] = 1

    def stop(self) -> None:
        """Stop the watchdog: outputs are not expected any more."""
        self.deadline_ns = None
        self._memory[_WATCHDOG_STATUS] = 1

    def check(self, now_ns: int) -> bool:
        """Return true once at its expiry, and count it."""
        if self.deadline_ns is None or now_ns < self.deadline_ns:
            return False
        self.deadline_ns = None
        memory = self._memory
        memory[_WATCHDOG_STATUS] = 0
        memory[Register.WATCHDOG_COUNTER] = min(memory[Register.WATCHDOG_COUNTER] + 1, 255)
        return True
