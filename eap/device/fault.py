"""Why a device does not change its state: codes with texts, about one object and sub-index.

The first two codes are those of the AL status (ETG.1000.6); configuration starts where that leaves
room for the device's own.
"""

from __future__ import annotations

from enum import IntEnum

from eap.errors import ConfigError
from eap.ids import ObjectId


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
    FaultCode.WRITER: "somebody else would have to write the variable",
    FaultCode.TIME_OUT: "time-out is too short",
    FaultCode.DEFAULT: "default is no value of the type",
    FaultCode.PORT: "port cannot do this",
    FaultCode.IN_USE: "station uses what is not there any more",
    FaultCode.POLL: "request and answer do not fit together",
    FaultCode.NO_ROOM: "does not fit into the dictionary",
    FaultCode.MONITORING: "nobody can be looked for",
}


class DeviceFault(ConfigError):  # noqa: N818  what the standard calls it
    """A state request was refused.

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
