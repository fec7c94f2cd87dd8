"""EtherCAT state machine of one slave: requests, time-outs and AL status codes (ETG.1000.6)."""

from __future__ import annotations

from collections.abc import Callable

from devicebus.errors import AlStatusError, BusError, StateTimeoutError
from devicebus.master.procedure import Procedure, Sleep, read, write
from devicebus.wire.alstatus import ERROR, AlState, name_of, state_name
from devicebus.wire.register import AlControl, AlStatus, Register

TIMEOUT_NS = {
    AlState.INIT: 5_000_000_000,
    AlState.PREOP: 3_000_000_000,
    AlState.BOOT: 3_000_000_000,
    AlState.SAFEOP: 10_000_000_000,
    AlState.OP: 10_000_000_000,
}
"""Time-out of each state change (ETG.1020)."""
ACKNOWLEDGE_TIMEOUT_NS = 200_000_000
POLL_NS = 500_000

_LADDER = (AlState.INIT, AlState.PREOP, AlState.SAFEOP, AlState.OP)


def path(current: AlState, target: AlState) -> tuple[AlState, ...]:
    """Return the states to request in turn on the way from *current* to *target*."""
    if current is target:
        return ()
    # BOOT is reached from INIT and left to INIT only (ETG.1000.6).
    if AlState.BOOT in {current, target}:
        through = (AlState.INIT,) if current is not AlState.INIT else ()
        start = AlState.INIT
        return through + ((target,) if target is AlState.BOOT else path(start, target))
    here, there = _LADDER.index(current), _LADDER.index(target)
    # Up one state at a time; down in one request, which slaves in any state accept.
    return _LADDER[here + 1 : there + 1] if there > here else (target,)


def read_status(station: int) -> Procedure[AlStatus]:
    """Return the AL status of a slave; raises WorkingCounterError if it does not answer."""
    octets = yield from read(station, Register.AL_STATUS, AlStatus.SIZE, "AL status")
    return AlStatus.decode(octets)


def acknowledge(station: int) -> Procedure[AlState]:
    """Acknowledge the error of a slave, if it has one; return its state.

    Raises:
        StateTimeoutError: the slave keeps the error.
        BusError: its state is undefined.
        WorkingCounterError: the slave does not answer.
    """
    status = yield from read_status(station)
    if status.error:
        # An error without a code is the master's acknowledge bit, mirrored by a controller in
        # device emulation (0x0141 bit 0).
        control = AlControl(status.state, acknowledge=int(status.code != 0)).encode()
        yield from write(station, Register.AL_CONTROL, control, "AL control")
        status = yield from _poll_until(
            station, lambda status: not status.error, ACKNOWLEDGE_TIMEOUT_NS
        )
        if status.error:
            raise StateTimeoutError(
                f"slave {station}: keeps its error 0x{status.code:04X} ({name_of(status.code)})"
                f" in {_name(status)}, expected it to be gone within 200 ms"
            )
    try:
        return AlState(status.state)
    except ValueError:
        raise BusError(f"slave {station}: {_name(status)} is no AL state") from None


def read_identification(station: int) -> Procedure[int]:
    """Return the identification that a slave shows on request; 0 if it has none (ETG.1020).

    The request is one of INIT: a slave may still be on its way there, and another state would call
    it back.

    Raises WorkingCounterError if it does not answer.
    """
    control = AlControl(AlState.INIT, identification=1).encode()
    yield from write(station, Register.AL_CONTROL, control, "AL control")
    status = yield from _poll_until(
        station, lambda status: bool(status.identification), ACKNOWLEDGE_TIMEOUT_NS
    )
    value = status.code if status.identification else 0
    # Without the request again: the AL status code is then that of errors.
    yield from write(station, Register.AL_CONTROL, AlControl(AlState.INIT).encode(), "AL control")
    return value


def change_state(
    station: int, target: AlState, *, timeout_ns: int | None = None
) -> Procedure[None]:
    """Change the state of a slave by one transition; an error is acknowledged first.

    Raises:
        AlStatusError: the slave refuses, with an AL status code.
        StateTimeoutError: the state is not reached within *timeout_ns*, by default the time of
            the standard.
        WorkingCounterError: the slave does not answer.
    """
    current = yield from acknowledge(station)
    if current is target:
        return
    yield from write(station, Register.AL_CONTROL, AlControl(target).encode(), "AL control")
    limit_ns = TIMEOUT_NS[target] if timeout_ns is None else timeout_ns
    status = yield from _poll_until(
        station, lambda status: bool(status.error) or status.state == target, limit_ns
    )
    if status.error:
        raise AlStatusError(
            f"slave {station}: refuses {target.name} and is in {_name(status)}:"
            f" AL status code 0x{status.code:04X}, {name_of(status.code)}",
            code=status.code,
            state=status.state,
        )
    if status.state != target:
        raise StateTimeoutError(
            f"slave {station}: still in {_name(status)}, expected {target.name} within"
            f" {limit_ns // 1_000_000} ms"
        )


def _poll_until(
    station: int, is_reached: Callable[[AlStatus], bool], timeout_ns: int
) -> Procedure[AlStatus]:
    """Read the AL status until *is_done* or the time-out; return the last one."""
    _, now_ns = yield Sleep(0)
    deadline_ns = now_ns + timeout_ns
    while True:
        status = yield from read_status(station)
        if is_reached(status) or now_ns >= deadline_ns:
            return status
        _, now_ns = yield Sleep(POLL_NS)


def _name(status: AlStatus) -> str:
    return state_name(status.state | (ERROR if status.error else 0))
