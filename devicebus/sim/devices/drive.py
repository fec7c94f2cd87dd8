"""A servo drive of the profile CiA 402: its objects, and the axis behind them.

It has no inertia: an enabled axis is where it was told to be (cyclic position, mode 8), or moves as
fast as it was told to (cyclic velocity, mode 9).
"""

from __future__ import annotations

import msgspec

from devicebus.sim.devices.cia402 import DriveCommand, DriveStateMachine
from devicebus.sim.spec import AccessKind, ChannelSpec, EntrySpec, ObjectSpec, SlaveSpec
from devicebus.wire.alstatus import AlState
from eap.od.dictionary import ObjectDictionary
from eap.od.model import Entry

CYCLIC_POSITION, CYCLIC_VELOCITY = 8, 9
DEVICE_TYPE = 0x0002_0192
"""Object 0x1000: servo drive of profile 402."""
_MODES = 1 << CYCLIC_POSITION - 1 | 1 << CYCLIC_VELOCITY - 1
_NS = 1_000_000_000

_OBJECTS = (
    ObjectSpec(index=0x603F, name="Error code", type="UINT", access=AccessKind.READ),
    ObjectSpec(index=0x6040, name="Controlword", type="UINT"),
    ObjectSpec(index=0x6041, name="Statusword", type="UINT", access=AccessKind.READ),
    ObjectSpec(index=0x6060, name="Modes of operation", type="SINT", value=CYCLIC_POSITION),
    ObjectSpec(index=0x6061, name="Modes of operation display", type="SINT",
               access=AccessKind.READ, value=CYCLIC_POSITION),
    ObjectSpec(index=0x6064, name="Position actual value", type="DINT", access=AccessKind.READ),
    ObjectSpec(index=0x606C, name="Velocity actual value", type="DINT", access=AccessKind.READ),
    ObjectSpec(index=0x607A, name="Target position", type="DINT"),
    ObjectSpec(index=0x60FF, name="Target velocity", type="DINT"),
    ObjectSpec(index=0x6502, name="Supported drive modes", type="UDINT",
               access=AccessKind.READ, value=_MODES),
    ObjectSpec(index=0x8000, name="Drive settings",
               entries=(EntrySpec(subindex=1, name="Parameter", type="UDINT"),)),
)  # fmt: skip
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
    objects = (*spec.objects, *(each for each in _OBJECTS if each.index not in own))
    if spec.inputs or spec.outputs:
        return msgspec.structs.replace(spec, objects=objects)
    return msgspec.structs.replace(spec, objects=objects, inputs=_INPUTS, outputs=_OUTPUTS)


class Drive:
    """The axis behind the objects of *dictionary*; a Behaviour of devicebus.sim.device."""

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self.machine = DriveStateMachine()
        self._dictionary = dictionary
        self._stepped_ns: int | None = None
        self.entry(0x6040).write = self._control
        self._show()

    def step(self, state: AlState, now_ns: int) -> None:
        """Follow the control word and the set points; out of OP the axis is switched off."""
        word = self.entry(0x6040).value if state is AlState.OP else 0
        self.machine.control(word)
        elapsed = 0 if self._stepped_ns is None else now_ns - self._stepped_ns
        self._stepped_ns = now_ns
        self._move(elapsed)
        self._show()

    def entry(self, index: int) -> Entry:
        """Return one of the variables of the profile."""
        return self._dictionary.entry(index, 0)

    def command(self, word: int) -> None:
        """Act on a control word that did not come as process data."""
        self.entry(0x6040).value = word
        self.machine.control(word)
        self._show()

    def fail(self, error_code: int) -> None:
        """Let the axis fail with an error code of the profile, until it is reset."""
        self.entry(0x603F).value = error_code
        self.machine.process(DriveCommand.FAULT)
        self._show()

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
            old, position.value = position.value, self.entry(0x607A).value
            if elapsed_ns:
                speed = (position.value - old) * _NS // elapsed_ns
                velocity.value = max(-(1 << 31), min((1 << 31) - 1, speed))
        elif mode == CYCLIC_VELOCITY:
            velocity.value = self.entry(0x60FF).value
            moved = position.value + velocity.value * elapsed_ns // _NS
            position.value = (moved + (1 << 31)) % (1 << 32) - (1 << 31)

    def _show(self) -> None:
        self.entry(0x6041).value = self.machine.status_word
