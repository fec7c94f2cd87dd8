"""The state machine of a drive (CiA 402, IEC 61800-7-201): control word in, status word out.

A fault is left by the rising edge of bit 7 only; everything else follows the low bits of the
control word, whatever was in it before.
"""

from __future__ import annotations

from enum import Enum, IntEnum, auto

FAULT_RESET_BIT = 0x80
_REMOTE = 0x0200
_VOLTAGE = 0x0010


class DriveState(IntEnum):
    """The states, as the status word shows them in bits 0 to 3, 5 and 6."""

    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT = 0x08


class DriveCommand(Enum):
    """What a control word asks for."""

    SHUTDOWN = auto()
    SWITCH_ON = auto()
    ENABLE = auto()
    DISABLE_VOLTAGE = auto()
    QUICK_STOP = auto()
    FAULT_RESET = auto()
    FAULT = auto()
    """From inside the drive."""


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
    """One axis.

    Attributes:
        state: Where it stands.
    """

    def __init__(self) -> None:
        self.state = DriveState.SWITCH_ON_DISABLED
        self._control_word = 0

    @property
    def is_enabled(self) -> bool:
        """Whether it follows its set points."""
        return self.state is DriveState.OPERATION_ENABLED

    @property
    def status_word(self) -> int:
        """The status word."""
        return self.state | _REMOTE | _VOLTAGE

    def control(self, word: int) -> None:
        """Act on a control word."""
        rising = word & ~self._control_word & FAULT_RESET_BIT
        self._control_word = word
        self.process(DriveCommand.FAULT_RESET if rising else command_of(word))

    def process(self, command: DriveCommand) -> None:
        """Change the state if *command* means anything in it."""
        self.state = TRANSITIONS.get((self.state, command), self.state)


def command_of(word: int) -> DriveCommand:
    """Return what the bits 0 to 3 of a control word ask for."""
    if not word & 0x02:
        return DriveCommand.DISABLE_VOLTAGE
    if not word & 0x04:
        return DriveCommand.QUICK_STOP
    if not word & 0x01:
        return DriveCommand.SHUTDOWN
    return DriveCommand.ENABLE if word & 0x08 else DriveCommand.SWITCH_ON
