"""A slave's EEPROM through the registers of its controller (ETG.1000.4, SII)."""

from __future__ import annotations

from devicebus.errors import SiiError
from devicebus.master.procedure import Procedure, Sleep, read, write
from devicebus.wire.register import EepromCommand, EepromControl, Register
from devicebus.wire.sii import CategoryHeader, SiiFixed

BUSY_TIMEOUT_NS = 20_000_000
"""Time-out for one EEPROM command."""
POLL_NS = 100_000
TRIES = 4
"""Attempts of a command that the EEPROM does not acknowledge."""
# The EEPROM stores a word in up to 10 ms and does not answer meanwhile.
RETRY_NS = 4_000_000
"""Pause between attempts."""
# Many EEPROMs declare no size.
MIN_LIMIT = 4096
"""Accepted size in bytes whatever the EEPROM declares."""
MAX_SIZE = 0x20000
"""Address range of 16 bit word addresses in bytes."""

_ADDRESS_AND_DATA = 14
_END = b"\xff\xff"


def take_over(station: int) -> Procedure[None]:
    """Take the EEPROM back from the slave's application."""
    # Bit 1 forces the release by the PDI, which may have kept the EEPROM; 0 assigns it to EtherCAT.
    yield from write(station, Register.EEPROM_CONFIGURATION, b"\2", "EEPROM configuration")
    yield from write(station, Register.EEPROM_CONFIGURATION, b"\0", "EEPROM configuration")


def read_words(station: int, word: int) -> Procedure[bytes]:
    """Read four or eight bytes, as many as the controller gives, from a word address on.

    Raises:
        SiiError: the EEPROM stays busy or does not acknowledge.
        WorkingCounterError: the slave did not answer.
    """
    request = EepromControl(command=EepromCommand.READ).encode() + word.to_bytes(4, "little")
    octets = yield from _command(station, request, f"reading word 0x{word:04X}")
    # Status bit 6: the controller reads eight bytes per command instead of four.
    size = 8 if EepromControl.decode(octets).read_eight else 4
    return octets[6 : 6 + size]


def write_word(station: int, word: int, data: bytes) -> Procedure[None]:
    """Write two bytes at a word address; raises as :func:`read_words` does."""
    control = EepromControl(write_enable=1, command=EepromCommand.WRITE).encode()
    request = control + word.to_bytes(4, "little") + data
    yield from _command(station, request, f"writing word 0x{word:04X}")


def reload(station: int) -> Procedure[None]:
    """Make the controller reload its configuration from the EEPROM, as after power-on."""
    request = EepromControl(command=EepromCommand.RELOAD).encode() + bytes(4)
    yield from _command(station, request, "reloading")


def read_image(station: int) -> Procedure[bytes]:
    """Read the EEPROM up to the end of its categories, end mark included.

    Raises:
        SiiError: there is no end within the size that the EEPROM says it has.
        WorkingCounterError: the slave did not answer.
    """
    yield from take_over(station)
    image = bytearray()
    yield from _extend(station, image, SiiFixed.SIZE)
    size = min(max((SiiFixed.decode(image).size + 1) * 128, MIN_LIMIT), MAX_SIZE)
    offset = SiiFixed.SIZE
    while True:
        if offset + CategoryHeader.SIZE > size:
            raise SiiError(f"slave {station}: no end of the EEPROM within its {size} bytes")
        yield from _extend(station, image, offset + CategoryHeader.SIZE)
        if image[offset : offset + 2] == _END:
            return bytes(image[: offset + 2])
        header = CategoryHeader.decode(image, offset)
        end = offset + CategoryHeader.SIZE + 2 * header.length
        if end > size:
            raise SiiError(
                f"slave {station}: EEPROM category {header.type} ends at byte {end}, expected at"
                f" most {size}"
            )
        yield from _extend(station, image, end)
        offset = end


def write_image(station: int, image: bytes) -> Procedure[None]:
    """Write an image word by word, except words that are equal already.

    Raises:
        SiiError: the image is of odd length, or the EEPROM does not take it.
        WorkingCounterError: the slave did not answer.
    """
    if len(image) % 2 or len(image) > MAX_SIZE:
        raise SiiError(f"an image of {len(image)} bytes, expected whole words up to {MAX_SIZE}")
    yield from take_over(station)
    there = bytearray()
    yield from _extend(station, there, len(image))
    for offset in range(0, len(image), 2):
        word = image[offset : offset + 2]
        # Writing is slow (up to 10 ms a word) and wears the EEPROM.
        if there[offset : offset + 2] != word:
            yield from write_word(station, offset // 2, word)


def _extend(station: int, image: bytearray, size: int) -> Procedure[None]:
    while len(image) < size:
        image += yield from read_words(station, len(image) // 2)


def _command(station: int, request: bytes, what: str) -> Procedure[bytes]:
    """Give a command, also again when it is not acknowledged; return registers from 0x0502 on."""
    for number in range(TRIES):
        if number:
            yield Sleep(RETRY_NS)
        yield from write(station, Register.EEPROM_CONTROL, request, "EEPROM control")
        octets = yield from _wait_idle(station, what)
        # An EEPROM that stores a word does not acknowledge: that is no fault yet.
        if not EepromControl.decode(octets).command_error:
            return octets
    raise SiiError(f"slave {station}: EEPROM, {what}: not acknowledged, tried {TRIES} times")


def _wait_idle(station: int, what: str) -> Procedure[bytes]:
    deadline_ns: int | None = None
    while True:
        octets = yield from read(
            station, Register.EEPROM_CONTROL, _ADDRESS_AND_DATA, "EEPROM control"
        )
        if not EepromControl.decode(octets).busy:
            return octets
        # The first pause is 0: it only brings the time, from which the time-out counts.
        _, now_ns = yield Sleep(0 if deadline_ns is None else POLL_NS)
        deadline_ns = deadline_ns or now_ns + BUSY_TIMEOUT_NS
        if now_ns >= deadline_ns:
            raise SiiError(f"slave {station}: EEPROM, {what}: busy for longer than 20 ms")
