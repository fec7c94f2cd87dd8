"""The EEPROM behind an ESC and the registers by which a master reaches it (ETG.1000.4)."""

from __future__ import annotations

from devicebus.wire import sii
from devicebus.wire.register import EepromCommand, Register

_WORDS = 2
_COMMAND_ERROR = 0x2000
_WRITE_ENABLE_ERROR = 0x4000
_CRC_ERROR = 0x0800
_READ_EIGHT = 0x0040
_TWO_BYTES = 0x0080
_WRITE_ENABLE = 0x0001
_OWNED_BY_PDI = 0x01


class Eeprom:
    """An image of words; what lies behind it reads as erased.

    Args:
        memory: Of the ESC.
        image: Octets, kept and changed by writes.
    """

    __slots__ = ("_memory", "image")

    def __init__(self, memory: bytearray, image: bytes) -> None:
        self._memory = memory
        self.image = bytearray(image)
        self._status(0)
        self.load(power_on=True)

    @property
    def is_masters(self) -> bool:
        """Whether the master may use the interface now."""
        return not self._memory[Register.EEPROM_CONFIGURATION] & _OWNED_BY_PDI

    def load(self, *, power_on: bool = False) -> None:
        """Load the configuration words; an image with a wrong check sum loads nothing.

        The alias is taken over at power-on only.
        """
        memory = self._memory
        if not sii.is_intact(self.image):
            self._status(_CRC_ERROR)
            return
        memory[Register.PDI_CONTROL : Register.PDI_CONTROL + 2] = self.image[0:2]
        memory[0x0150:0x0152] = self.image[2:4]
        memory[0x0152:0x0154] = self.image[6:8]
        if power_on:
            memory[Register.STATION_ALIAS : Register.STATION_ALIAS + 2] = self.image[8:10]

    def ownership_written(self) -> None:
        """The master gave the interface away, or took it by force (bit 1)."""
        memory = self._memory
        if memory[Register.EEPROM_CONFIGURATION] & 2:
            memory[Register.EEPROM_PDI_ACCESS] = 0

    def control_written(self) -> None:
        """Execute the command that was written to the control register."""
        at = Register.EEPROM_CONTROL
        control = int.from_bytes(self._memory[at : at + 2], "little")
        self._status(0)
        command = control >> 8 & 7
        at = Register.EEPROM_ADDRESS
        offset = int.from_bytes(self._memory[at : at + 4], "little") * _WORDS
        if command == EepromCommand.READ:
            octets = self.image[offset : offset + 8]
            self._memory[Register.EEPROM_DATA : Register.EEPROM_DATA + 8] = octets.ljust(8, b"\xff")
        elif command == EepromCommand.WRITE:
            if control & _WRITE_ENABLE:
                self._write_word(offset)
            else:
                self._status(_WRITE_ENABLE_ERROR)
        elif command == EepromCommand.RELOAD:
            self.load()
        elif command != EepromCommand.NONE:
            self._status(_COMMAND_ERROR)

    def _write_word(self, offset: int) -> None:
        if offset + _WORDS > len(self.image):
            self._status(_COMMAND_ERROR)
            return
        at = Register.EEPROM_DATA
        self.image[offset : offset + _WORDS] = self._memory[at : at + _WORDS]

    def _status(self, errors: int) -> None:
        at = Register.EEPROM_CONTROL
        status = errors | _READ_EIGHT | _TWO_BYTES
        self._memory[at : at + 2] = status.to_bytes(2, "little")
