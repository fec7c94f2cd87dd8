"""A servo drive of the profile CiA 402: its objects, and the axes behind them.

The objects of each axis lie 0x800 above those of the axis before (ETG.6010).  An axis has no
inertia: enabled, it is where it was told to be (cyclic position, mode 8), or moves as fast as it
was told to (cyclic velocity, mode 9).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import msgspec

from devicebus.sim.devices.cia402 import DriveCommand, DriveState, DriveStateMachine
from devicebus.sim.spec import AccessKind, ChannelSpec, EntrySpec, ObjectSpec, SlaveSpec
from devicebus.wire.alstatus import AlState
from eap.od.dictionary import ObjectDictionary
from eap.od.model import Entry

CYCLIC_POSITION, CYCLIC_VELOCITY = 8, 9
DEVICE_TYPE = 0x0002_0192
"""Object 0x1000: servo drive of profile 402."""
_MODES = 1 << CYCLIC_POSITION - 1 | 1 << CYCLIC_VELOCITY - 1
_NS = 1_000_000_000
AXIS_OBJECTS = 0x800
AXIS_PDOS = 0x10
"""Between the PDOs of two axes."""
_RX_PDO, _TX_PDO = 0x1600, 0x1A00
FOLLOWING_ERROR = 0x8611
NO_WINDOW = 0xFFFF_FFFF

_OBJECTS = (
    ObjectSpec(index=0x603F, name="Error code", type="UINT", access=AccessKind.READ),
    ObjectSpec(index=0x6040, name="Controlword", type="UINT"),
    ObjectSpec(index=0x6041, name="Statusword", type="UINT", access=AccessKind.READ),
    ObjectSpec(index=0x6060, name="Modes of operation", type="SINT", value=CYCLIC_POSITION),
    ObjectSpec(index=0x6061, name="Modes of operation display", type="SINT",
               access=AccessKind.READ, value=CYCLIC_POSITION),
    ObjectSpec(index=0x6064, name="Position actual value", type="DINT", access=AccessKind.READ),
    ObjectSpec(index=0x606C, name="Velocity actual value", type="DINT", access=AccessKind.READ),
    ObjectSpec(index=0x6065, name="Following error window", type="UDINT", value=NO_WINDOW),
    ObjectSpec(index=0x607A, name="Target position", type="DINT"),
    ObjectSpec(index=0x60FF, name="Target velocity", type="DINT"),
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


def _moved(item: ObjectSpec, axis: int) -> ObjectSpec:
    return msgspec.structs.replace(item, index=item.index + AXIS_OBJECTS * axis)


def _mapped(channel: ChannelSpec, pdo: int, axis: int) -> ChannelSpec:
    """The channels of the first axis have the plain names, the others a number behind them."""
    return msgspec.structs.replace(
        channel,
        name=f"{channel.name}_{axis}" if axis else channel.name,
        object=f"{int(channel.object, 16) + AXIS_OBJECTS * axis:#06x}",
        pdo=pdo + AXIS_PDOS * axis,
    )


class Axes:
    """The axes of one drive; a Behaviour of devicebus.sim.device."""

    def __init__(self, drives: Iterable[Drive]) -> None:
        self.drives = tuple(drives)

    def step(self, state: AlState, now_ns: int) -> None:
        """Let every axis act."""
        for drive in self.drives:
            drive.step(state, now_ns)


class Drive:
    """One axis behind the objects of *dictionary*.

    Args:
        dictionary: Of the device.
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
        self._obey(self.entry(0x6040).value if state is AlState.OP else 0)
        elapsed = 0 if self._stepped_ns is None else now_ns - self._stepped_ns
        self._stepped_ns = now_ns
        self._move(elapsed)
        self._show()

    def entry(self, index: int) -> Entry:
        """Return one of the variables of the profile."""
        return self._dictionary.entry(index + self._offset, 0)

    def command(self, word: int) -> None:
        """Act on a control word that did not come as process data."""
        self.entry(0x6040).value = word
        self._obey(word)
        self._show()

    def fail(self, error_code: int) -> None:
        """Let the axis fail with an error code of the profile, until it is reset."""
        self.entry(0x603F).value = error_code
        self.machine.process(DriveCommand.FAULT)
        self._show()
        if self.report is not None:
            self.report(error_code)

    def reset(self) -> None:
        """Leave the fault."""
        self._end_fault(lambda: self.machine.process(DriveCommand.FAULT_RESET))

    def _obey(self, word: int) -> None:
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
            position.value = (moved + (1 << 31)) % (1 << 32) - (1 << 31)

    def _show(self) -> None:
        self.entry(0x6041).value = self.machine.status_word
