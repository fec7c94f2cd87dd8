"""The process data watchdog of an ESC: outputs that stop coming are noticed (ETG.1000.4)."""

from __future__ import annotations

from devicebus.wire.register import Register

_STATUS = int(Register.WATCHDOG_STATUS)
_TICK_NS = 40
"""The ESC counts in steps of 25 MHz."""


class Watchdog:
    """Fed by every complete write to a sync manager that is watched.

    Attributes:
        deadline_ns: When it runs out; None while nothing has fed it or it is switched off.
        timeout_ns: How long outputs may stay away; 0 switches the watchdog off.
    """

    __slots__ = ("_memory", "deadline_ns", "timeout_ns")

    def __init__(self, memory: bytearray) -> None:
        self._memory = memory
        self.deadline_ns: int | None = None
        memory[Register.WATCHDOG_DIVIDER : Register.WATCHDOG_DIVIDER + 2] = b"\xc2\x09"
        for at in (Register.WATCHDOG_PDI, Register.WATCHDOG_PROCESS_DATA):
            memory[at : at + 2] = b"\xe8\x03"
        memory[_STATUS] = 1
        self.configure()

    def configure(self) -> None:
        """Take over the registers."""
        at, memory = Register.WATCHDOG_DIVIDER, self._memory
        divider = int.from_bytes(memory[at : at + 2], "little") + 2
        at = Register.WATCHDOG_PROCESS_DATA
        self.timeout_ns = divider * _TICK_NS * int.from_bytes(memory[at : at + 2], "little")

    def feed(self, now_ns: int) -> None:
        """Outputs have come."""
        self.deadline_ns = now_ns + self.timeout_ns if self.timeout_ns else None
        self._memory[_STATUS] = 1

    def stop(self) -> None:
        """Outputs are not expected any more."""
        self.deadline_ns = None
        self._memory[_STATUS] = 1

    def check(self, now_ns: int) -> bool:
        """Return whether it has run out just now."""
        if self.deadline_ns is None or now_ns < self.deadline_ns:
            return False
        self.deadline_ns = None
        memory = self._memory
        memory[_STATUS] = 0
        memory[Register.WATCHDOG_COUNTER] = min(memory[Register.WATCHDOG_COUNTER] + 1, 255)
        return True
