"""Configuration of one slave by its master, as plain data.

A bus file, a plant file or an ESI file describes it; ``devicebus.master`` carries it out, in the
order of the state machine (ETG.1000.6).  None and empty fields leave the slave as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Annotated

import msgspec
from msgspec import Meta

Milliseconds = Annotated[int, Meta(ge=0, le=600_000)]
WatchdogMs = Annotated[int, Meta(ge=0, le=6553)]
"""A register of 16 bits counts steps of 100 µs."""
US = 1000
"""Nanoseconds of a microsecond."""


class Transition(StrEnum):
    """Change of the AL state, by the first letters of the two states (ETG.1000.6).

    A master goes up by one state at a time, and down in one step from any state to any lower one.
    """

    IP = "IP"
    PS = "PS"
    SO = "SO"
    OS = "OS"
    OP = "OP"
    OI = "OI"
    SP = "SP"
    SI = "SI"
    PI = "PI"

    @property
    def is_up(self) -> bool:
        """True from INIT towards OP."""
        return self in {Transition.IP, Transition.PS, Transition.SO}


class SdoWrite(msgspec.Struct, frozen=True, kw_only=True, tag="sdo", tag_field="by"):
    """SDO download in each of *at*; with *complete* the object from *subindex* 0 or 1 on."""

    at: tuple[Transition, ...] = (Transition.PS,)
    index: int
    subindex: int = 0
    data: bytes
    """As transferred, least significant byte first."""
    complete: bool = False
    comment: str = ""


class IdnWrite(msgspec.Struct, frozen=True, kw_only=True, tag="idn", tag_field="by"):
    """SoE write of the value of an IDN in each of *at*; a list includes its length header."""

    at: tuple[Transition, ...] = (Transition.PS,)
    idn: int
    """The 16 bits of the wire: ``P-0-0001`` is 0x8001."""
    data: bytes
    drive: int = 0
    comment: str = ""


class MappedObject(msgspec.Struct, frozen=True):
    """Entry of a PDO mapping; index 0 is padding."""

    index: int
    subindex: int
    bit_length: int


class SyncSignals(msgspec.Struct, frozen=True, kw_only=True):
    """SYNC0 and SYNC1 as their registers have them; times in nanoseconds."""

    activate: int
    """AssignActivate: the low byte for register 0x0980, the high byte for 0x0981."""
    cycle0_ns: int
    shift0_ns: int = 0
    """Shift of SYNC0 from the start of the common cycle."""
    cycle1_ns: int = 0
    """Register 0x09A4: the time from SYNC0 to SYNC1."""


class OpMode(msgspec.Struct, frozen=True, kw_only=True):
    """Operation mode of a distributed clock (ESI element OpMode), by itself without a cycle.

    A cycle time is a number of nanoseconds or, if that is 0, a factor: of the bus cycle for SYNC0;
    for SYNC1 of SYNC0's cycle, or of the bus cycle if the factor is negative.  A negative factor
    divides.
    """

    name: str = ""
    activate: int = 0x0300
    """AssignActivate; 0 switches SYNC0 and SYNC1 off."""
    cycle0_ns: int = 0
    factor0: int = 1
    shift0_ns: int = 0
    shift0_factor: int = 0
    """Further shift as a factor of the cycle of SYNC0."""
    cycle1_ns: int = 0
    factor1: int = 0
    shift1_ns: int = 0

    def signals(self, cycle_ns: int) -> SyncSignals | None:
        """Return the signals for a bus cycle; None if the mode uses none."""
        if not self.activate >> 8:
            return None
        # A factor of 0 would be a single pulse: such modes follow the bus.
        cycle0 = self.cycle0_ns or _scaled(cycle_ns, self.factor0) or cycle_ns
        base = cycle0 if self.factor1 >= 0 else cycle_ns
        cycle1 = self.cycle1_ns or _scaled(base, self.factor1)
        return SyncSignals(
            activate=self.activate,
            cycle0_ns=cycle0,
            shift0_ns=self.shift0_ns + _scaled(cycle0, self.shift0_factor),
            cycle1_ns=max(0, cycle1 - cycle0) + self.shift1_ns,
        )


def _scaled(cycle_ns: int, factor: int) -> int:
    return cycle_ns * factor if factor >= 0 else cycle_ns // -factor


class Watchdogs(msgspec.Struct, frozen=True, kw_only=True):
    """Watchdogs of a slave's controller; 0 switches one off."""

    process_data_ms: WatchdogMs | None = None
    """Without outputs for so long the slave leaves OP."""
    pdi_ms: WatchdogMs | None = None
    """Without an access of its application for so long it is reported."""
    enabled: bool | None = None
    """Trigger of the process data watchdog by the sync managers of outputs (control bit 6)."""


class StateTimeouts(msgspec.Struct, frozen=True, kw_only=True):
    """Time-outs of state changes and mailbox answers in ms (ESI element Timeout).

    None is that of the master.
    """

    preop_ms: Milliseconds | None = None
    safeop_op_ms: Milliseconds | None = None
    back_to_init_ms: Milliseconds | None = None
    back_to_safeop_ms: Milliseconds | None = None
    response_ms: Milliseconds | None = None
    """Of an answer to a start-up write."""


class RevisionRule(StrEnum):
    """Comparison of a slave's revision with the expected one (ESI attribute CheckRevisionNo).

    Many vendors have the revision in the high word and a special version in the low one.
    """

    EXACT = "exact"
    AT_LEAST = "at_least"
    ANY = "any"
    SAME_LOW = "same_low"
    SAME_LOW_AT_LEAST = "same_low_at_least"
    SAME_HIGH = "same_high"
    SAME_HIGH_AT_LEAST = "same_high_at_least"

    def accepts(self, expected: int, found: int) -> bool:
        """Return true if a slave with revision *found* may stand for the expected one."""
        return _ACCEPTS[self](expected, found)

    def describe(self, expected: int) -> str:
        """Return the accepted revisions in words."""
        return _WORDS[self].format(f"0x{expected:08X}", low=expected & _LOW, high=expected >> 16)


_LOW = 0xFFFF
_ACCEPTS: Mapping[RevisionRule, Callable[[int, int], bool]] = MappingProxyType(
    {
        RevisionRule.EXACT: lambda want, has: has == want,
        RevisionRule.AT_LEAST: lambda want, has: has >= want,
        RevisionRule.ANY: lambda want, has: True,
        RevisionRule.SAME_LOW: lambda want, has: has & _LOW == want & _LOW,
        RevisionRule.SAME_LOW_AT_LEAST: lambda want, has: has & _LOW == want & _LOW and has >= want,
        RevisionRule.SAME_HIGH: lambda want, has: has >> 16 == want >> 16,
        RevisionRule.SAME_HIGH_AT_LEAST: lambda want, has: has >> 16 == want >> 16 and has >= want,
    }
)
_WORDS: Mapping[RevisionRule, str] = MappingProxyType(
    {
        RevisionRule.EXACT: "revision {}",
        RevisionRule.AT_LEAST: "revision {} or later",
        RevisionRule.ANY: "any revision",
        RevisionRule.SAME_LOW: "a revision that ends in {low:04X}",
        RevisionRule.SAME_LOW_AT_LEAST: "revision {} or a later one that ends in {low:04X}",
        RevisionRule.SAME_HIGH: "a revision that begins with 0x{high:04X}",
        RevisionRule.SAME_HIGH_AT_LEAST: (
            "revision {} or a later one that begins with 0x{high:04X}"
        ),
    }
)

ALIAS_REGISTER = 0x0012
"""Register with the alias of the EEPROM (ESI: StationAliasSupported)."""
BY_SERIAL = 0
"""In place of a register: the serial number in the EEPROM."""
ID_REGISTER = 0x0134
"""Register with the identification that a slave shows on request (ESI: IdentificationReg134)."""


class SlaveConfig(msgspec.Struct, frozen=True, kw_only=True):
    """Configuration of a slave; the master repeats it after each restart of the slave."""

    assignment: Mapping[int, tuple[int, ...]] = {}
    """PDOs by sync manager, written to 0x1C10 + n on the way to SAFEOP."""
    mapping: Mapping[int, tuple[MappedObject, ...]] = {}
    """Entries by PDO, written before the assignment."""
    fixed_pdos: bool = False
    """True if the slave does not take its assignment by SDO, or has no CoE (ESI: PdoAssign)."""
    writes: tuple[SdoWrite | IdnWrite, ...] = ()
    """Start-up writes; those of one transition are sent in this order."""
    sync: OpMode | None = None
    """SYNC0 and SYNC1; None leaves them off."""
    watchdogs: Watchdogs = Watchdogs()
    timeouts: StateTimeouts = StateTimeouts()
    optional: bool = False
    """True if the slave may be absent: it is taken in when it is plugged in."""
    group: str = ""
    """Hot-connect group, whose slaves are connected together."""
    revision_rule: RevisionRule = RevisionRule.EXACT
    identification: int = ALIAS_REGISTER
    """Register, or BY_SERIAL, that holds the value by which the slave is told from equal ones."""
