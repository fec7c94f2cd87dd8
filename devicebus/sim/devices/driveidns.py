"""The IDNs of a simulated drive: the same axis as by CoE, under the names of SoE (IEC 61800-7-300).

In the master control word, bits 13 to 15 together switch the axis on; the status word answers in
bits 14 and 15, and with a fault in bit 13.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from devicebus.errors import SoeError
from devicebus.mailbox.soe_parameter import SoeParameter
from devicebus.mailbox.soe_procedure import Procedure
from devicebus.sim.devices.cia402 import DriveState
from devicebus.sim.devices.drive import Drive
from eap.codec.soe import Display, Idn, SoeAttribute
from eap.codec.soeerror import SoeErrorCode, name_of

_SWITCH_ON = 0xE000
_SHUTDOWN, _ENABLE = 0x0006, 0x000F
_RESET_NS = 10_000_000
_HOMING_NS = 50_000_000
_WORD = SoeAttribute(length=1, display=Display.HEXADECIMAL)
_WORD_READ_ONLY = SoeAttribute(
    length=1, display=Display.HEXADECIMAL, protected_preop=1, protected_safeop=1, protected_op=1
)
_DOUBLE = SoeAttribute(display=Display.UNSIGNED)
_SIGNED = SoeAttribute(display=Display.SIGNED)
_SIGNED_READ_ONLY = SoeAttribute(
    display=Display.SIGNED, protected_preop=1, protected_safeop=1, protected_op=1
)
_TEXT = SoeAttribute(
    length=0, is_list=1, display=Display.TEXT, protected_preop=1, protected_safeop=1, protected_op=1
)
_IDNS = SoeAttribute(length=1, is_list=1, display=Display.IDN, protected_safeop=1, protected_op=1)
_COMMAND = SoeAttribute(length=1, is_command=1, display=Display.BINARY)
_IN_AT = ("S-0-0135", "S-0-0051")
_IN_MDT = ("S-0-0134", "S-0-0047")


def parameters(drive: Drive, version: str) -> list[SoeParameter]:
    """Return the IDNs of *drive*, whose software has *version*."""
    return [*_lists(version), *_words(drive), *_set_points(drive)]


def _lists(version: str) -> Iterator[SoeParameter]:
    yield SoeParameter("S-0-0016", "Configuration list of AT", _IDNS, _numbers(_IN_AT),
                       max_length=32)  # fmt: skip
    yield SoeParameter("S-0-0024", "Configuration list of MDT", _IDNS, _numbers(_IN_MDT),
                       max_length=32)  # fmt: skip
    yield SoeParameter("S-0-0030", "Manufacturer version", _TEXT, version)
    yield SoeParameter("S-0-0032", "Primary operation mode", _DOUBLE, 2)


def _words(drive: Drive) -> Iterator[SoeParameter]:
    yield SoeParameter("S-0-0134", "Master control word", _WORD, write=_control(drive))
    yield SoeParameter(
        "S-0-0135", "Drive status word", _WORD_READ_ONLY, read=lambda: _status(drive)
    )
    reset = Procedure(duration_ns=_RESET_NS, finish=lambda: _reset(drive))
    yield SoeParameter("S-0-0099", "Reset class 1 diagnostic", _COMMAND, procedure=reset)
    home = Procedure(
        duration_ns=_HOMING_NS,
        start=lambda: _check_enabled(drive),
        finish=lambda: _home(drive),
    )
    yield SoeParameter("S-0-0148", "Drive controlled homing", _COMMAND, procedure=home)


def _set_points(drive: Drive) -> Iterator[SoeParameter]:
    for idn, name, index in (
        ("S-0-0036", "Velocity command value", 0x60FF),
        ("S-0-0047", "Position command value", 0x607A),
    ):
        yield SoeParameter(idn, name, _SIGNED, unit="inc", read=_reader(drive, index),
                           write=_writer(drive, index))  # fmt: skip
    for idn, name, index in (
        ("S-0-0040", "Velocity feedback value", 0x606C),
        ("S-0-0051", "Position feedback value", 0x6064),
    ):
        yield SoeParameter(idn, name, _SIGNED_READ_ONLY, unit="inc", read=_reader(drive, index))


def _numbers(idns: tuple[str, ...]) -> list[int]:
    return [Idn.parse(idn).number for idn in idns]


def _reader(drive: Drive, index: int) -> Callable[[], bytes]:
    return lambda: drive.entry(index).octets


def _writer(drive: Drive, index: int) -> Callable[[bytes], None]:
    def write(octets: bytes) -> None:
        drive.entry(index).octets = octets

    return write


def _control(drive: Drive) -> Callable[[bytes], None]:
    def write(octets: bytes) -> None:
        on = int.from_bytes(octets, "little") & _SWITCH_ON == _SWITCH_ON
        drive.command(_SHUTDOWN)
        if on:
            drive.command(_ENABLE)

    return write


def _status(drive: Drive) -> bytes:
    state = drive.machine.state
    if state is DriveState.FAULT:
        word = 0x2000
    elif state is DriveState.OPERATION_ENABLED:
        word = 0xC000
    else:
        word = 0x4000 if state is not DriveState.SWITCH_ON_DISABLED else 0
    return word.to_bytes(2, "little")


def _reset(drive: Drive) -> bool:
    drive.reset()
    return True


def _check_enabled(drive: Drive) -> None:
    if not drive.machine.is_enabled:
        code = SoeErrorCode.COMMAND_NOT_NOW
        raise SoeError(name_of(code), code=code)


def _home(drive: Drive) -> bool:
    """Call the place where the axis is 0; an axis that was switched off meanwhile fails."""
    if drive.machine.is_enabled:
        drive.entry(0x607A).value = drive.entry(0x6064).value = 0
    return drive.machine.is_enabled
