"""AL states and AL status codes of a slave (ETG.1000.6)."""

from __future__ import annotations

from enum import IntEnum


class AlState(IntEnum):
    """AL control and AL status, bits 0 to 3."""

    INIT = 1
    PREOP = 2
    BOOT = 3
    SAFEOP = 4
    OP = 8


WITH_PROCESS_DATA = frozenset((AlState.SAFEOP, AlState.OP))
WITH_MAILBOX = WITH_PROCESS_DATA | {AlState.PREOP}
"""States with process data, and with the standard mailbox; BOOT has a mailbox of its own."""
ERROR = 0x10
"""Error bit: in AL status a refused request, in AL control its acknowledgement."""

_TEXTS = {
    0x0000: "no error",
    0x0001: "unspecified error",
    0x0002: "no memory",
    0x0003: "invalid device setup",
    0x0004: "invalid revision",
    0x0006: "SII does not match firmware",
    0x0007: "firmware update failed, old one runs",
    0x000E: "licence error",
    0x0011: "invalid requested state change",
    0x0012: "unknown requested state",
    0x0013: "bootstrap not supported",
    0x0014: "no valid firmware",
    0x0015: "invalid mailbox configuration for Boot",
    0x0016: "invalid mailbox configuration for PreOp",
    0x0017: "invalid sync manager configuration",
    0x0018: "no valid inputs available",
    0x0019: "no valid outputs",
    0x001A: "synchronization error",
    0x001B: "sync manager watchdog",
    0x001C: "invalid sync manager types",
    0x001D: "invalid output configuration",
    0x001E: "invalid input configuration",
    0x001F: "invalid watchdog configuration",
    0x0020: "slave needs a cold start",
    0x0021: "slave needs Init",
    0x0022: "slave needs PreOp",
    0x0023: "slave needs SafeOp",
    0x0024: "invalid input mapping",
    0x0025: "invalid output mapping",
    0x0026: "inconsistent settings",
    0x0027: "free run not supported",
    0x0028: "synchronization not supported",
    0x0029: "free run needs 3-buffer mode",
    0x002A: "background watchdog",
    0x002B: "no valid inputs and outputs",
    0x002C: "fatal sync error",
    0x002D: "no sync error",
    # Stacks give this code two meanings, so the text names both.
    0x002E: "cycle time too small, or invalid input FMMU configuration",
    0x0030: "invalid DC SYNC configuration",
    0x0031: "invalid DC latch configuration",
    0x0032: "PLL error",
    0x0033: "DC SYNC I/O error",
    0x0034: "DC SYNC time-out",
    0x0035: "invalid SYNC cycle time",
    0x0036: "invalid SYNC0 cycle time",
    0x0037: "invalid SYNC1 cycle time",
    0x0041: "AoE mailbox error",
    0x0042: "EoE mailbox error",
    0x0043: "CoE mailbox error",
    0x0044: "FoE mailbox error",
    0x0045: "SoE mailbox error",
    0x004F: "VoE mailbox error",
    0x0050: "EEPROM not accessible",
    0x0051: "EEPROM error",
    0x0052: "external hardware not ready",
    0x0060: "slave restarted locally",
    0x0061: "device identification value updated",
    0x0070: "detected module ident list does not match",
    0x0080: "supply voltage too low",
    0x0081: "supply voltage too high",
    0x0082: "temperature too low",
    0x0083: "temperature too high",
    0x00F0: "application controller available",
}


class AlStatusCode(IntEnum):
    """Codes that this project sends or evaluates; all others are only displayed."""

    NO_ERROR = 0x0000
    UNSPECIFIED = 0x0001
    INVALID_STATE_CHANGE = 0x0011
    UNKNOWN_STATE = 0x0012
    BOOT_NOT_SUPPORTED = 0x0013
    MAILBOX_BOOT = 0x0015
    MAILBOX_PREOP = 0x0016
    SYNC_MANAGER = 0x0017
    NO_INPUTS = 0x0018
    NO_OUTPUTS = 0x0019
    SYNCHRONIZATION = 0x001A
    WATCHDOG = 0x001B
    OUTPUT_CONFIGURATION = 0x001D
    INPUT_CONFIGURATION = 0x001E
    DC_SYNC_CONFIGURATION = 0x0030


def name_of(code: int) -> str:
    """Return the text of an AL status code, also of one that the standard does not define."""
    return _TEXTS.get(code, f"code 0x{code:04X} of the vendor")


def state_name(status: int) -> str:
    """Return the text of an AL status, such as ``SAFEOP+ERROR``."""
    state = status & 0x0F
    name = AlState(state).name if state in set(AlState) else f"state {state}"
    return f"{name}+ERROR" if status & ERROR else name
