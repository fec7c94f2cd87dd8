from __future__ import annotations

import pytest

from devicebus.errors import SoeError
from devicebus.mailbox.soe_procedure import CLEAR, START, Procedure
from eap.codec.soe import DataState
from eap.codec.soeerror import SoeErrorCode


def code_of(procedure: Procedure, value: int, now_ns: int) -> SoeErrorCode:
    with pytest.raises(SoeError) as caught:
        procedure.command(value, now_ns)
    return SoeErrorCode(caught.value.code)


def test_life_of_a_command() -> None:
    procedure = Procedure(duration_ns=100)
    assert procedure.state(0) == 0
    procedure.command(START, 10)
    assert procedure.state(109) == DataState.BUSY == 0x0007
    assert code_of(procedure, START, 109) is SoeErrorCode.COMMAND_ACTIVE
    assert procedure.state(110) == DataState.DONE == 0x0003
    assert code_of(procedure, START, 111) is SoeErrorCode.COMMAND_ACTIVE
    procedure.command(CLEAR, 112)
    assert procedure.state(112) == 0
    procedure.command(START, 113)
    assert procedure.state(113) == DataState.BUSY


def test_hooks_run_once_at_start_and_end() -> None:
    seen: list[str] = []
    procedure = Procedure(
        duration_ns=5,
        start=lambda: seen.append("start"),
        finish=lambda: bool(seen.append("finish")) or True,
    )
    procedure.command(START, 0)
    for now_ns in (0, 4, 5, 6):
        procedure.state(now_ns)
    assert seen == ["start", "finish"]


def test_command_that_does_not_succeed_has_failed() -> None:
    procedure = Procedure(finish=lambda: False)
    procedure.command(START, 0)
    assert procedure.state(0) == DataState.FAILED == 0x000F
    procedure.command(CLEAR, 0)
    assert procedure.state(0) == 0


def test_start_may_be_refused() -> None:
    def refuse() -> None:
        raise SoeError("no power", code=SoeErrorCode.COMMAND_NOT_NOW)

    procedure = Procedure(start=refuse)
    assert code_of(procedure, START, 0) is SoeErrorCode.COMMAND_NOT_NOW
    assert procedure.state(0) == 0


@pytest.mark.parametrize("is_interruptible", [True, False])
def test_clearing_what_runs(is_interruptible: bool) -> None:
    procedure = Procedure(duration_ns=9, is_interruptible=is_interruptible)
    procedure.command(START, 0)
    if is_interruptible:
        procedure.command(CLEAR, 1)
        assert procedure.state(99) == 0
    else:
        assert code_of(procedure, CLEAR, 1) is SoeErrorCode.COMMAND_NOT_INTERRUPTIBLE
        assert procedure.state(9) == DataState.DONE


@pytest.mark.parametrize("value", [1, 2, 7, 0xFFFF])
def test_other_values_are_invalid(value: int) -> None:
    assert code_of(Procedure(), value, 0) is SoeErrorCode.INVALID_VALUE
