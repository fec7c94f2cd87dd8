"""The EAP device's states: which of them send and which receive.

Rule 1: every transition is in TRANSITIONS; whoever asks for another is told what was possible.
Rule 2: PreOp exchanges no process data, SafeOp sends, Op sends and receives (ETG.1005).
"""

from __future__ import annotations

from enum import Enum, IntEnum, auto

from eap.errors import LocalProtocolError


class DeviceState(IntEnum):
    """Numbered as the AL status numbers the states of a slave (ETG.1000.6)."""

    INIT = 1
    PREOP = 2
    SAFEOP = 4
    OP = 8

    @property
    def sends(self) -> bool:
        """Whether TxFrames are sent."""
        return self in {DeviceState.SAFEOP, DeviceState.OP}

    @property
    def receives(self) -> bool:
        """Whether RxPDs are taken."""
        return self is DeviceState.OP


class Request(Enum):
    """What can be asked of a device."""

    START = auto()
    """From Init to PreOp; only the device itself asks for it."""
    PREOP = auto()
    SAFEOP = auto()
    OP = auto()


TRANSITIONS: dict[tuple[DeviceState, Request], DeviceState] = {
    (DeviceState.INIT, Request.START): DeviceState.PREOP,
    (DeviceState.PREOP, Request.PREOP): DeviceState.PREOP,
    (DeviceState.PREOP, Request.SAFEOP): DeviceState.SAFEOP,
    (DeviceState.SAFEOP, Request.PREOP): DeviceState.PREOP,
    (DeviceState.SAFEOP, Request.SAFEOP): DeviceState.SAFEOP,
    (DeviceState.SAFEOP, Request.OP): DeviceState.OP,
    (DeviceState.OP, Request.PREOP): DeviceState.PREOP,
    (DeviceState.OP, Request.SAFEOP): DeviceState.SAFEOP,
    (DeviceState.OP, Request.OP): DeviceState.OP,
}


_UP = {
    DeviceState.INIT: Request.START,
    DeviceState.PREOP: Request.SAFEOP,
    DeviceState.SAFEOP: Request.OP,
}
_DOWN = {DeviceState.PREOP: Request.PREOP, DeviceState.SAFEOP: Request.SAFEOP}


class Device:
    """The state of one station's EAP device."""

    def __init__(self) -> None:
        self.state = DeviceState.INIT

    def request(self, what: Request) -> DeviceState:
        """Go to another state and return it; raise LocalProtocolError if there is no way."""
        try:
            self.state = TRANSITIONS[self.state, what]
        except KeyError:
            possible = [r.name for s, r in TRANSITIONS if s is self.state]
            raise LocalProtocolError(
                f"{what.name} cannot be requested in {self.state.name}, "
                f"only {' or '.join(possible)}"
            ) from None
        return self.state

    def go(self, state: DeviceState) -> None:
        """Go to *state* by all states between; raise LocalProtocolError for Init."""
        if state is DeviceState.INIT:
            raise LocalProtocolError("INIT cannot be requested, only PREOP, SAFEOP or OP")
        while self.state < state:
            self.request(_UP[self.state])
        if self.state > state:
            self.request(_DOWN[state])
