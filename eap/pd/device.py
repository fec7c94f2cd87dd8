"""States of the EAP device, and faults: reasons for which it does not change its state.

Rule 1: every transition is in TRANSITIONS; the error for another one names the possible ones.
Rule 2: PreOp exchanges no process data, SafeOp sends, Op sends and receives (ETG.1005).
Rule 3: fault codes of transitions are those of the AL status (ETG.1000.6); those of configuration
start where that leaves room for the device's own.
"""

from __future__ import annotations

from enum import Enum, IntEnum, auto

from eap.errors import ConfigError, LocalProtocolError
from eap.ids import ObjectId


class DeviceState(IntEnum):
    """Numbered as the AL status numbers the states of a slave (ETG.1000.6)."""

    INIT = 1
    PREOP = 2
    SAFEOP = 4
    OP = 8

    @property
    def sends(self) -> bool:
        """True if TxFrames are sent."""
        return self in {DeviceState.SAFEOP, DeviceState.OP}

    @property
    def receives(self) -> bool:
        """True if RxPDs are received."""
        return self is DeviceState.OP


class StateRequest(Enum):
    """States that can be requested of a device."""

    START = auto()
    """From Init to PreOp; only the device itself requests it."""
    PREOP = auto()
    SAFEOP = auto()
    OP = auto()


TRANSITIONS: dict[tuple[DeviceState, StateRequest], DeviceState] = {
    (DeviceState.INIT, StateRequest.START): DeviceState.PREOP,
    # The present state may be requested: a client that repeats its request gets no error.
    (DeviceState.PREOP, StateRequest.PREOP): DeviceState.PREOP,
    (DeviceState.PREOP, StateRequest.SAFEOP): DeviceState.SAFEOP,
    (DeviceState.SAFEOP, StateRequest.PREOP): DeviceState.PREOP,
    (DeviceState.SAFEOP, StateRequest.SAFEOP): DeviceState.SAFEOP,
    (DeviceState.SAFEOP, StateRequest.OP): DeviceState.OP,
    (DeviceState.OP, StateRequest.PREOP): DeviceState.PREOP,
    (DeviceState.OP, StateRequest.SAFEOP): DeviceState.SAFEOP,
    (DeviceState.OP, StateRequest.OP): DeviceState.OP,
}


_UP = {
    DeviceState.INIT: StateRequest.START,
    DeviceState.PREOP: StateRequest.SAFEOP,
    DeviceState.SAFEOP: StateRequest.OP,
}
_DOWN = {DeviceState.PREOP: StateRequest.PREOP, DeviceState.SAFEOP: StateRequest.SAFEOP}


class EapDevice:
    """The state of one station's EAP device."""

    def __init__(self) -> None:
        self.state = DeviceState.INIT

    def request(self, what: StateRequest) -> DeviceState:
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
        # No transition leads from PreOp to Op directly; downwards one step reaches every state.
        while self.state < state:
            self.request(_UP[self.state])
        if self.state > state:
            self.request(_DOWN[state])


class FaultCode(IntEnum):
    """The error codes of the EAP status."""

    INVALID_REQUEST = 0x0011
    UNKNOWN_STATE = 0x0012
    NO_MAILBOX = 0x0016
    NOT_RUNNING = 0x8000
    MISSING_OBJECT = 0x8001
    NO_PDO = 0x8002
    EMPTY_PDO = 0x8003
    BAD_MAPPING = 0x8004
    NO_DESTINATION = 0x8005
    EMPTY_FRAME = 0x8006
    FRAME_TOO_LONG = 0x8007
    PD_WITHOUT_FRAME = 0x8008
    PD_IN_TWO_FRAMES = 0x8009
    NAME = 0x800A
    NAME_TWICE = 0x800B
    PD_ID_TWICE = 0x800C
    CYCLE_TIME = 0x800D
    TRIGGERS = 0x800E
    MODULO = 0x800F
    GATE = 0x8010
    RECEIVED_TWICE = 0x8011
    WRITER = 0x8012
    TIME_OUT = 0x8013
    DEFAULT = 0x8014
    PORT = 0x8015
    IN_USE = 0x8016
    POLL = 0x8017
    NO_ROOM = 0x8018
    MONITORING = 0x8019


FAULT_TEXTS = {
    FaultCode.INVALID_REQUEST: "state cannot be requested now",
    FaultCode.UNKNOWN_STATE: "no state of the device",
    FaultCode.NO_MAILBOX: "mailbox is not set up",
    FaultCode.NOT_RUNNING: "engine did not take the configuration",
    FaultCode.MISSING_OBJECT: "reference to an object that does not exist",
    FaultCode.NO_PDO: "PD has no PDO",
    FaultCode.EMPTY_PDO: "PDO maps no variable",
    FaultCode.BAD_MAPPING: "mapping does not fit what it maps",
    FaultCode.NO_DESTINATION: "frame has no destination that its port reaches",
    FaultCode.EMPTY_FRAME: "frame carries no enabled PD",
    FaultCode.FRAME_TOO_LONG: "frame is too long",
    FaultCode.PD_WITHOUT_FRAME: "PD is in no frame",
    FaultCode.PD_IN_TWO_FRAMES: "PD is listed twice",
    FaultCode.NAME: "name cannot be used",
    FaultCode.NAME_TWICE: "name exists already",
    FaultCode.PD_ID_TWICE: "PD ID is used twice",
    FaultCode.CYCLE_TIME: "cycle time does not fit the device cycle",
    FaultCode.TRIGGERS: "triggers exclude each other",
    FaultCode.MODULO: "modulo never comes up",
    FaultCode.GATE: "PD is due when its frame is not",
    FaultCode.RECEIVED_TWICE: "received twice",
    FaultCode.WRITER: "variable has another writer",
    FaultCode.TIME_OUT: "time-out is too short",
    FaultCode.DEFAULT: "default is no value of the type",
    FaultCode.PORT: "port cannot do this",
    FaultCode.IN_USE: "station uses an object that is not there any more",
    FaultCode.POLL: "request and answer do not fit together",
    FaultCode.NO_ROOM: "does not fit into the dictionary",
    FaultCode.MONITORING: "subscriber cannot be monitored",
}


class DeviceFault(ConfigError):  # noqa: N818  what the standard calls it
    """A state request failed.

    Attributes:
        code: The error code.
        text: The same in words, with its object.
        index: The object it is about; 0 if about none.
        subindex: Its entry.
        port: Name of the port that the object is of; empty if of none.
    """

    def __init__(
        self, code: FaultCode, detail: str = "", index: int = 0, subindex: int = 0, port: str = ""
    ) -> None:
        where = f"{ObjectId(index, subindex)}: " if index else ""
        reason = f": {detail}" if detail else ""
        super().__init__(f"{where}{FAULT_TEXTS[code]}{reason}")
        self.code = code
        self.index = index
        self.subindex = subindex
        self.port = port
        self.text = str(self)
