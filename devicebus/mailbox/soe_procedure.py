"""A procedure command of a simulated drive: what it does, and its data state (IEC 61800-7-300).

Writing 3 (set and enabled) starts it, writing 0 clears it; it is to be cleared before it can start
again, also when it is done.
"""

from __future__ import annotations

from collections.abc import Callable

from devicebus.errors import SoeError
from eap.codec.soe import DataState
from eap.codec.soeerror import SoeErrorCode, name_of

START = DataState.SET | DataState.ENABLED
CLEAR = 0


class Procedure:
    """One procedure command.

    Args:
        duration_ns: How long it takes.
        start: Called when it starts; refuses with SoeError, such as COMMAND_NOT_NOW.
        finish: Called when its time is over; returns whether it succeeded.
        is_interruptible: Whether it may be cleared before it is done.
    """

    def __init__(
        self,
        *,
        duration_ns: int = 0,
        start: Callable[[], None] | None = None,
        finish: Callable[[], bool] | None = None,
        is_interruptible: bool = True,
    ) -> None:
        self.duration_ns = duration_ns
        self._start = start
        self._finish = finish
        self._is_interruptible = is_interruptible
        self._state = DataState(0)
        self._end_ns = 0

    def command(self, value: int, now_ns: int) -> None:
        """Act on what was written to the IDN; raise SoeError if it cannot be done."""
        state = self.state(now_ns)
        if value == CLEAR:
            if state == DataState.BUSY and not self._is_interruptible:
                raise _refusal(SoeErrorCode.COMMAND_NOT_INTERRUPTIBLE)
            self._state = DataState(0)
            return
        if value != START:
            raise _refusal(SoeErrorCode.INVALID_VALUE)
        if state:
            raise _refusal(SoeErrorCode.COMMAND_ACTIVE)
        if self._start is not None:
            self._start()
        self._state = DataState.BUSY
        self._end_ns = now_ns + self.duration_ns

    def state(self, now_ns: int) -> DataState:
        """Return the data state, after finishing what is due."""
        if self._state == DataState.BUSY and now_ns >= self._end_ns:
            is_good = self._finish is None or self._finish()
            self._state = DataState.DONE if is_good else DataState.FAILED
        return self._state


def _refusal(code: SoeErrorCode) -> SoeError:
    return SoeError(name_of(code), code=code)
