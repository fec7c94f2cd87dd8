"""SoE error codes: why a drive refuses (IEC 61800-7-300)."""

from __future__ import annotations

from enum import IntEnum


class SoeErrorCode(IntEnum):
    """The codes of the standard; a peer may send others, which stay plain integers."""

    NO_IDN = 0x1001
    ELEMENT_1_ACCESS = 0x1009
    NO_NAME = 0x2001
    NAME_TOO_SHORT = 0x2002
    NAME_TOO_LONG = 0x2003
    NAME_READ_ONLY = 0x2004
    NAME_PROTECTED = 0x2005
    ATTRIBUTE_TOO_SHORT = 0x3002
    ATTRIBUTE_TOO_LONG = 0x3003
    ATTRIBUTE_READ_ONLY = 0x3004
    ATTRIBUTE_PROTECTED = 0x3005
    NO_UNIT = 0x4001
    UNIT_TOO_SHORT = 0x4002
    UNIT_TOO_LONG = 0x4003
    UNIT_READ_ONLY = 0x4004
    UNIT_PROTECTED = 0x4005
    NO_MINIMUM = 0x5001
    MINIMUM_TOO_SHORT = 0x5002
    MINIMUM_TOO_LONG = 0x5003
    MINIMUM_READ_ONLY = 0x5004
    MINIMUM_PROTECTED = 0x5005
    NO_MAXIMUM = 0x6001
    MAXIMUM_TOO_SHORT = 0x6002
    MAXIMUM_TOO_LONG = 0x6003
    MAXIMUM_READ_ONLY = 0x6004
    MAXIMUM_PROTECTED = 0x6005
    VALUE_TOO_SHORT = 0x7002
    VALUE_TOO_LONG = 0x7003
    VALUE_READ_ONLY = 0x7004
    VALUE_PROTECTED = 0x7005
    BELOW_MINIMUM = 0x7006
    ABOVE_MAXIMUM = 0x7007
    INVALID_VALUE = 0x7008
    PASSWORD = 0x7009
    CYCLIC = 0x700A
    INDIRECT = 0x700B
    OTHER_SETTINGS = 0x700C
    COMMAND_ACTIVE = 0x7010
    COMMAND_NOT_INTERRUPTIBLE = 0x7011
    COMMAND_NOT_NOW = 0x7012
    COMMAND_PARAMETERS = 0x7013
    NO_DATA_STATE = 0x7014
    NO_DEFAULT = 0x8001
    DEFAULT_TOO_LONG = 0x8002
    DEFAULT_READ_ONLY = 0x8004
    INVALID_DRIVE = 0x800A
    GENERAL = 0x800B
    NO_ELEMENT = 0x800C


_TEXTS = {
    SoeErrorCode.NO_IDN: "no such IDN",
    SoeErrorCode.ELEMENT_1_ACCESS: "invalid access to element 1",
    SoeErrorCode.NO_NAME: "no name",
    SoeErrorCode.NO_UNIT: "no unit",
    SoeErrorCode.NO_MINIMUM: "no minimum",
    SoeErrorCode.NO_MAXIMUM: "no maximum",
    SoeErrorCode.BELOW_MINIMUM: "value is below the minimum",
    SoeErrorCode.ABOVE_MAXIMUM: "value is above the maximum",
    SoeErrorCode.INVALID_VALUE: "invalid value",
    SoeErrorCode.PASSWORD: "value is protected by a password",
    SoeErrorCode.CYCLIC: "value is write protected: it is configured cyclically",
    SoeErrorCode.INDIRECT: "invalid indirect addressing",
    SoeErrorCode.OTHER_SETTINGS: "value is write protected by other settings",
    SoeErrorCode.COMMAND_ACTIVE: "procedure command is already active",
    SoeErrorCode.COMMAND_NOT_INTERRUPTIBLE: "procedure command cannot be interrupted",
    SoeErrorCode.COMMAND_NOT_NOW: "procedure command cannot be executed now",
    SoeErrorCode.COMMAND_PARAMETERS: "procedure command cannot be executed: invalid parameters",
    SoeErrorCode.NO_DATA_STATE: "no data state",
    SoeErrorCode.NO_DEFAULT: "no default",
    SoeErrorCode.DEFAULT_TOO_LONG: "default is too long",
    SoeErrorCode.DEFAULT_READ_ONLY: "default is read only",
    SoeErrorCode.INVALID_DRIVE: "invalid drive number",
    SoeErrorCode.GENERAL: "general error",
    SoeErrorCode.NO_ELEMENT: "no element addressed",
}
for _number, _element in (
    (0x2000, "name"),
    (0x3000, "attribute"),
    (0x4000, "unit"),
    (0x5000, "minimum"),
    (0x6000, "maximum"),
    (0x7000, "value"),
):
    for _low, _reason in (
        (2, "is too short"),
        (3, "is too long"),
        (4, "is read only"),
        (5, "is write protected now"),
    ):
        _TEXTS[SoeErrorCode(_number | _low)] = f"{_element} {_reason}"


def name_of(code: int) -> str:
    """Return what *code* means, also when the standard does not know it."""
    try:
        return _TEXTS[SoeErrorCode(code)]
    except ValueError:
        return "error code of the vendor"
