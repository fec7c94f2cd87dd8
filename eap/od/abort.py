"""SDO abort codes: reasons of a dictionary to refuse (ETG.1000.6, SDO abort codes)."""

from __future__ import annotations

from enum import IntEnum

from eap.errors import EapError
from eap.ids import ObjectId


class AbortCode(IntEnum):
    """The codes of the standard; a peer may send others, which stay plain integers."""

    TOGGLE = 0x05030000
    TIMEOUT = 0x05040000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE = 0x05040003
    CRC = 0x05040004
    OUT_OF_MEMORY = 0x05040005
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    SUBINDEX_0_NOT_ZERO = 0x06010003
    NO_COMPLETE_ACCESS = 0x06010004
    LONGER_THAN_MAILBOX = 0x06010005
    MAPPED = 0x06010006
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    PARAMETER = 0x06040043
    INTERNAL = 0x06040047
    HARDWARE = 0x06060000
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    MODULE_LIST = 0x06090033
    MAXIMUM_BELOW_MINIMUM = 0x06090036
    RESOURCE = 0x060A0023
    GENERAL = 0x08000000
    NOT_STORED = 0x08000020
    LOCAL_CONTROL = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DICTIONARY = 0x08000023
    NO_DATA = 0x08000024


_TEXTS = {
    AbortCode.TOGGLE: "toggle bit not alternated",
    AbortCode.TIMEOUT: "SDO protocol timed out",
    AbortCode.COMMAND: "command specifier not valid or unknown",
    AbortCode.BLOCK_SIZE: "invalid block size",
    AbortCode.SEQUENCE: "invalid sequence number",
    AbortCode.CRC: "CRC error of a block",
    AbortCode.OUT_OF_MEMORY: "out of memory",
    AbortCode.UNSUPPORTED_ACCESS: "unsupported access to an object",
    AbortCode.WRITE_ONLY: "read of a write-only entry",
    AbortCode.READ_ONLY: "write of a read-only entry",
    AbortCode.SUBINDEX_0_NOT_ZERO: "subindex cannot be written while subindex 0 is not zero",
    AbortCode.NO_COMPLETE_ACCESS: "object does not support complete access",
    AbortCode.LONGER_THAN_MAILBOX: "object is longer than the mailbox",
    AbortCode.MAPPED: "object is mapped to an RxPDO, so downloads are blocked",
    AbortCode.NO_OBJECT: "object does not exist",
    AbortCode.NOT_MAPPABLE: "object cannot be mapped into a PDO",
    AbortCode.PDO_LENGTH: "mapped objects are longer than the PDO",
    AbortCode.PARAMETER: "incompatible parameters",
    AbortCode.INTERNAL: "incompatible within the device",
    AbortCode.HARDWARE: "access failed because of a hardware error",
    AbortCode.LENGTH: "data type or length does not match",
    AbortCode.TOO_LONG: "data is longer than the entry",
    AbortCode.TOO_SHORT: "data is shorter than the entry",
    AbortCode.NO_SUBINDEX: "subindex does not exist",
    AbortCode.VALUE: "value is out of range",
    AbortCode.TOO_HIGH: "value is above the maximum",
    AbortCode.TOO_LOW: "value is below the minimum",
    AbortCode.MODULE_LIST: "configured and detected modules differ",
    AbortCode.MAXIMUM_BELOW_MINIMUM: "maximum is below minimum",
    AbortCode.RESOURCE: "resource not available",
    AbortCode.GENERAL: "general error",
    AbortCode.NOT_STORED: "data cannot be transferred or stored",
    AbortCode.LOCAL_CONTROL: "data cannot be transferred or stored: local control",
    AbortCode.DEVICE_STATE: "data cannot be transferred or stored in this device state",
    AbortCode.NO_DICTIONARY: "no object dictionary, or making it failed",
    AbortCode.NO_DATA: "no data available",
}


def name_of(code: int) -> str:
    """Return the meaning of *code*, which may be of the vendor."""
    try:
        return _TEXTS[AbortCode(code)]
    except ValueError:
        return "abort code of the vendor"


class SdoAbortError(EapError):
    """An SDO transfer was refused; *code* says why, by us or by the peer."""

    def __init__(self, code: int, index: int, subindex: int, detail: str = "") -> None:
        reason = f": {detail}" if detail else ""
        super().__init__(f"{ObjectId(index, subindex)}: {name_of(code)} (0x{code:08X}){reason}")
        self.code = code
        self.index = index
        self.subindex = subindex
