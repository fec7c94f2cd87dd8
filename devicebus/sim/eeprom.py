"""EEPROM behind an ESC and its registers (ETG.1000.4).

A command takes time: until its end the controller is busy and accepts no other.
"""

from __future__ import annotations

from devicebus.wire import sii
from devicebus.wire.register import EepromCommand, Register

READ_NS = 50_000
WRITE_NS = 1_000_000
RELOAD_NS = 500_000
_WORDS = 2
_BUSY = 0x8000
_COMMAND_ERROR = 0x2000
_WRITE_ENABLE_ERROR = 0x4000
_CRC_ERROR = 0x0800
_READ_EIGHT = 0x0040
_TWO_BYTES = 0x0080
_WRITE_ENABLE = 0x0001
_COMMAND = 0x0700
_OWNED_BY_PDI = 0x01
_DURATION: dict[int, int] = {
    EepromCommand.READ: READ_NS,
    EepromCommand.WRITE: WRITE_NS,
    EepromCommand.RELOAD: RELOAD_NS,
}


class Eeprom:
    """EEPROM image; words behind its end read as erased.

    Args:
        memory: Memory of the ESC.
        image: Content, changed by writes.

    Attributes:
        extra_ns: Fault: additional time of each command.
        is_broken: Fault: no command is acknowledged.
        busy_until_ns: End of the command under way; None without one.
    """

    __slots__ = ("_control", "_memory", "busy_until_ns", "extra_ns", "image", "is_broken")

    def __init__(self, memory: bytearray, image: bytearray) -> None:
        self._memory = memory
        self.image = image
        self.extra_ns = 0
        self.is_broken = False
        self.busy_until_ns: int | None = None
        self._control = 0
        self._status(0)
        self._load(power_on=True)

    @property
    def is_with_master(self) -> bool:
        """True while the interface is assigned to the master."""
        return not self._memory[Register.EEPROM_CONFIGURATION] & _OWNED_BY_PDI

    def ownership_written(self) -> None:
        """Handle a write that assigns the interface to the PDI, or forces it back (bit 1)."""
        memory = self._memory
        if memory[Register.EEPROM_CONFIGURATION] & 2:
            memory[Register.EEPROM_PDI_ACCESS] = 0

    def control_written(self, now_ns: int) -> None:
        """Start the command that was written to the control register."""
        at = Register.EEPROM_CONTROL
        control = int.from_bytes(self._memory[at : at + 2], "little")
        command = control >> 8 & 7
        self._status(0)
        if command == EepromCommand.NONE:
            return
        if command not in _DURATION:
            self._status(_COMMAND_ERROR)
        elif command == EepromCommand.WRITE and not control & _WRITE_ENABLE:
            self._status(_WRITE_ENABLE_ERROR)
        else:
            # Executed at the end of the busy time; writes to these registers are refused until
            # then.
            self._control = control
            self.busy_until_ns = now_ns + _DURATION[command] + self.extra_ns
            self._status(_BUSY | control & _COMMAND)

    def finish_command(self, now_ns: int) -> None:
        """Finish the command if its time is over."""
        if self.busy_until_ns is None or now_ns < self.busy_until_ns:
            return
        self.busy_until_ns = None
        self._status(_COMMAND_ERROR if self.is_broken else 0)
        if not self.is_broken:
            self._execute(self._control >> 8 & 7)

    def _execute(self, command: int) -> None:
        at = Register.EEPROM_ADDRESS
        offset = int.from_bytes(self._memory[at : at + 4], "little") * _WORDS
        if command == EepromCommand.READ:
            octets = self.image[offset : offset + 8]
            self._memory[Register.EEPROM_DATA : Register.EEPROM_DATA + 8] = octets.ljust(8, b"\xff")
        elif command == EepromCommand.WRITE:
            self._write_word(offset)
        else:
            self._load()

    def _load(self, *, power_on: bool = False) -> None:
        """Load the configuration words; an image with a wrong check sum loads nothing.

        The alias is loaded at power-on only.
        """
        memory = self._memory
        # A controller with a wrong check sum keeps running, with bit 11 of its status set.
        if not sii.is_intact(self.image):
            self._status(_CRC_ERROR)
            return
        memory[Register.PDI_CONTROL : Register.PDI_CONTROL + 2] = self.image[0:2]
        memory[0x0150:0x0152] = self.image[2:4]
        memory[0x0152:0x0154] = self.image[6:8]
        if power_on:
            memory[Register.STATION_ALIAS : Register.STATION_ALIAS + 2] = self.image[8:10]

    def _write_word(self, offset: int) -> None:
        if offset + _WORDS > len(self.image):
            self._status(_COMMAND_ERROR)
            return
        at = Register.EEPROM_DATA
        self.image[offset : offset + _WORDS] = self._memory[at : at + _WORDS]

    def _status(self, bits: int) -> None:
        at = Register.EEPROM_CONTROL
        # This EEPROM is larger than 16 Kbit (two address bytes) and is read eight bytes at a time.
        status = bits | _READ_EIGHT | _TWO_BYTES
        self._memory[at : at + 2] = status.to_bytes(2, "little")
