"""Servo drive of the profile CiA 402: state machine, objects, axes, and IDNs of SoE.

The objects of each axis are 0x800 above those of the axis before (ETG.6010).  An axis has no
inertia: once enabled it is at its target position (cyclic position, mode 8), or moves at its target
velocity (cyclic velocity, mode 9).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from enum import Enum, IntEnum, auto

import msgspec

from devicebus.errors import SoeError
from devicebus.mailbox.soe_server import ProcedureCommand, SoeParameter
from devicebus.sim.devices.objects import described_object
from devicebus.sim.spec import AccessKind, ChannelSpec, EntrySpec, ObjectSpec, SlaveSpec
from devicebus.wire.alstatus import AlState
from eap.codec.soe import Display, Idn, SoeAttribute, SoeErrorCode, name_of
from eap.od.dictionary import ObjectDictionary
from eap.od.model import Entry, ObjectCode

FAULT_RESET_BIT = 0x80
_REMOTE = 0x0200
_VOLTAGE = 0x0010


class DriveState(IntEnum):
    """States of an axis with the values of status word bits 0 to 3, 5 and 6."""

    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT = 0x08


class DriveCommand(Enum):
    """Commands of a control word."""

    SHUTDOWN = auto()
    SWITCH_ON = auto()
    ENABLE = auto()
    DISABLE_VOLTAGE = auto()
    QUICK_STOP = auto()
    FAULT_RESET = auto()
    FAULT = auto()
    """Transition caused by the drive itself."""


_S, _C = DriveState, DriveCommand
TRANSITIONS: dict[tuple[DriveState, DriveCommand], DriveState] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): _S.SWITCHED_ON,
    (_S.READY_TO_SWITCH_ON, _C.ENABLE): _S.OPERATION_ENABLED,
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,
    (_S.SWITCHED_ON, _C.ENABLE): _S.OPERATION_ENABLED,
    (_S.SWITCHED_ON, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,
    (_S.SWITCHED_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): _S.SWITCHED_ON,
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): _S.QUICK_STOP_ACTIVE,
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE): _S.OPERATION_ENABLED,
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,
    (_S.FAULT, _C.FAULT_RESET): _S.SWITCH_ON_DISABLED,
    **{(state, _C.FAULT): _S.FAULT for state in _S},
}


class DriveStateMachine:
    """State machine of one axis.

    Attributes:
        state: Present state.
    """

    def __init__(self) -> None:
        self.state = DriveState.SWITCH_ON_DISABLED
        self._control_word = 0

    @property
    def is_enabled(self) -> bool:
        """True while the axis follows its set points."""
        return self.state is DriveState.OPERATION_ENABLED

    @property
    def status_word(self) -> int:
        """Status word of the present state."""
        return self.state | _REMOTE | _VOLTAGE

    def control(self, word: int) -> None:
        """Execute a control word."""
        # Only an edge resets: a bit that stays set must not clear the next fault at once.
        rising = word & ~self._control_word & FAULT_RESET_BIT
        self._control_word = word
        self.process(DriveCommand.FAULT_RESET if rising else command_of(word))

    def process(self, command: DriveCommand) -> None:
        """Execute *command* if the present state allows it."""
        self.state = TRANSITIONS.get((self.state, command), self.state)


def command_of(word: int) -> DriveCommand:
    """Return the command in bits 0 to 3 of a control word."""
    if not word & 0x02:
        return DriveCommand.DISABLE_VOLTAGE
    if not word & 0x04:
        return DriveCommand.QUICK_STOP
    if not word & 0x01:
        return DriveCommand.SHUTDOWN
    return DriveCommand.ENABLE if word & 0x08 else DriveCommand.SWITCH_ON


CYCLIC_POSITION, CYCLIC_VELOCITY = 8, 9
DEVICE_TYPE = 0x0002_0192
"""Value of object 0x1000: servo drive of profile 402."""
_MODES = 1 << CYCLIC_POSITION - 1 | 1 << CYCLIC_VELOCITY - 1
_NS = 1_000_000_000
AXIS_OBJECTS = 0x800
AXIS_PDOS = 0x10
"""Distance between the PDOs of two axes."""
_RX_PDO, _TX_PDO = 0x1600, 0x1A00
FOLLOWING_ERROR = 0x8611
NO_WINDOW = 0xFFFF_FFFF
_WINDOW = 0x6065

_OBJECTS = (
    ObjectSpec(index=0x603F, name="Error code", type="UINT", access=AccessKind.READ, mappable=True),
    ObjectSpec(index=0x6040, name="Controlword", type="UINT"),
    ObjectSpec(index=0x6041, name="Statusword", type="UINT", access=AccessKind.READ),
    ObjectSpec(index=0x6060, name="Modes of operation", type="SINT", value=CYCLIC_POSITION,
               mappable=True),
    ObjectSpec(index=0x6061, name="Modes of operation display", type="SINT",
               access=AccessKind.READ, value=CYCLIC_POSITION, mappable=True),
    ObjectSpec(index=0x6064, name="Position actual value", type="DINT", access=AccessKind.READ),
    ObjectSpec(index=0x606C, name="Velocity actual value", type="DINT", access=AccessKind.READ,
               mappable=True),
    ObjectSpec(index=0x6065, name="Following error window", type="UDINT", value=NO_WINDOW),
    ObjectSpec(index=0x607A, name="Target position", type="DINT"),
    ObjectSpec(index=0x60FF, name="Target velocity", type="DINT", mappable=True),
    ObjectSpec(index=0x6502, name="Supported drive modes", type="UDINT",
               access=AccessKind.READ, value=_MODES),
)  # fmt: skip
_SETTINGS = ObjectSpec(
    index=0x8000,
    name="Drive settings",
    entries=(EntrySpec(subindex=1, name="Parameter", type="UDINT"),),
)
_OUTPUTS = (
    ChannelSpec(name="controlword", type="UINT", object="0x6040"),
    ChannelSpec(name="target_position", type="DINT", object="0x607A"),
)
_INPUTS = (
    ChannelSpec(name="statusword", type="UINT", object="0x6041"),
    ChannelSpec(name="position", type="DINT", object="0x6064"),
)


def complete(spec: SlaveSpec) -> SlaveSpec:
    """Add the objects of the profile that *spec* lacks, and its process data if it has none."""
    own = {each.index for each in spec.objects}
    profile = [_moved(each, axis) for axis in range(spec.axes) for each in _OBJECTS]
    objects = (*spec.objects, *(each for each in (*profile, _SETTINGS) if each.index not in own))
    if spec.inputs or spec.outputs:
        return msgspec.structs.replace(spec, objects=objects)
    return msgspec.structs.replace(
        spec,
        objects=objects,
        inputs=tuple(_mapped(each, _TX_PDO, axis) for axis in range(spec.axes) for each in _INPUTS),
        outputs=tuple(
            _mapped(each, _RX_PDO, axis) for axis in range(spec.axes) for each in _OUTPUTS
        ),
    )


def add_missing(dictionary: ObjectDictionary, axes: int) -> None:
    """Add the objects of the profile that the description of a drive leaves out.

    Raises:
        ValueError: an object of the profile is no number.
    """
    for axis in range(axes):
        for spec in _OBJECTS:
            item = _moved(spec, axis)
            if item.index not in dictionary:
                dictionary.add(described_object(item))
            entry = dictionary[item.index].entries[0]
            if dictionary[item.index].code is not ObjectCode.VAR or not entry.kind.scalar_range:
                raise ValueError(f"profile drive: object 0x{item.index:04X} is no number")
        window = dictionary.entry(_WINDOW + AXIS_OBJECTS * axis, 0)
        # A window of 0 without a unit would fail every motion.
        if not window.value and window.kind.bit_length == 32:
            window.value = NO_WINDOW


def _moved(item: ObjectSpec, axis: int) -> ObjectSpec:
    return msgspec.structs.replace(item, index=item.index + AXIS_OBJECTS * axis)


def _mapped(channel: ChannelSpec, pdo: int, axis: int) -> ChannelSpec:
    """Return a channel of an axis; names of axes after the first have a number."""
    return msgspec.structs.replace(
        channel,
        name=f"{channel.name}_{axis}" if axis else channel.name,
        object=f"{int(channel.object, 16) + AXIS_OBJECTS * axis:#06x}",
        pdo=pdo + AXIS_PDOS * axis,
    )


class Axes:
    """Axes of one drive; a Behaviour of devicebus.sim.device."""

    def __init__(self, drives: Iterable[Drive]) -> None:
        self.drives = tuple(drives)

    def step(self, state: AlState, now_ns: int) -> None:
        """Run every axis."""
        for drive in self.drives:
            drive.step(state, now_ns)


class Drive:
    """Axis behind the objects of *dictionary*.

    Args:
        dictionary: Dictionary of the device.
        axis: Number of the axis.

    Attributes:
        report: Called with the error code when the axis fails, and with 0 when it is reset.
    """

    def __init__(self, dictionary: ObjectDictionary, axis: int = 0) -> None:
        self.machine = DriveStateMachine()
        self.report: Callable[[int], None] | None = None
        self._dictionary = dictionary
        self._offset = AXIS_OBJECTS * axis
        self._stepped_ns: int | None = None
        self.entry(0x6040).write = self._control
        self._show()

    def step(self, state: AlState, now_ns: int) -> None:
        """Follow the control word and the set points; out of OP the axis is switched off."""
        # Out of OP no control word arrives: the drive must not go on by the last one.
        self._execute(self.entry(0x6040).value if state is AlState.OP else 0)
        elapsed = 0 if self._stepped_ns is None else now_ns - self._stepped_ns
        self._stepped_ns = now_ns
        self._move(elapsed)
        self._show()

    def entry(self, index: int) -> Entry:
        """Return the entry of a profile object."""
        return self._dictionary.entry(index + self._offset, 0)

    def command(self, word: int) -> None:
        """Execute a control word from outside of the process data."""
        self.entry(0x6040).value = word
        self._execute(word)
        self._show()

    def fail(self, error_code: int) -> None:
        """Put the axis into Fault with an error code of the profile."""
        self.entry(0x603F).value = error_code
        self.machine.process(DriveCommand.FAULT)
        self._show()
        if self.report is not None:
            self.report(error_code)

    def reset(self) -> None:
        """Reset the fault."""
        self._end_fault(lambda: self.machine.process(DriveCommand.FAULT_RESET))

    def _execute(self, word: int) -> None:
        self._end_fault(lambda: self.machine.control(word))

    def _end_fault(self, act: Callable[[], None]) -> None:
        failed = self.machine.state is DriveState.FAULT
        act()
        if failed and self.machine.state is not DriveState.FAULT:
            self.entry(0x603F).value = 0
            if self.report is not None:
                self.report(0)

    def _control(self, octets: bytes) -> None:
        self.command(int.from_bytes(octets, "little"))

    def _move(self, elapsed_ns: int) -> None:
        position, velocity = self.entry(0x6064), self.entry(0x606C)
        mode = self.entry(0x6060).value
        self.entry(0x6061).value = mode
        velocity.value = 0
        if not self.machine.is_enabled:
            return
        if mode == CYCLIC_POSITION:
            old, target = position.value, self.entry(0x607A).value
            # 0xFFFFFFFF switches the supervision of the following error off.
            if abs(target - old) > self.entry(0x6065).value < NO_WINDOW:
                self.fail(FOLLOWING_ERROR)
                return
            position.value = target
            if elapsed_ns:
                speed = (position.value - old) * _NS // elapsed_ns
                velocity.value = max(-(1 << 31), min((1 << 31) - 1, speed))
        elif mode == CYCLIC_VELOCITY:
            velocity.value = self.entry(0x60FF).value
            moved = position.value + velocity.value * elapsed_ns // _NS
            # The position wraps, as a counter of 32 bits does.
            position.value = (moved + (1 << 31)) % (1 << 32) - (1 << 31)

    def _show(self) -> None:
        self.entry(0x6041).value = self.machine.status_word


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
    """Return the IDNs of *drive* with software version *version*."""
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
    reset = ProcedureCommand(duration_ns=_RESET_NS, finish=lambda: _reset(drive))
    yield SoeParameter("S-0-0099", "Reset class 1 diagnostic", _COMMAND, procedure=reset)
    home = ProcedureCommand(
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
    """Set the present position to 0; an axis that was disabled meanwhile fails."""
    if drive.machine.is_enabled:
        drive.entry(0x607A).value = drive.entry(0x6064).value = 0
    return drive.machine.is_enabled
