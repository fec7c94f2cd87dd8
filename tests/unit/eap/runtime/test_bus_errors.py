"""Errors that cross a process and are what they were."""

from __future__ import annotations

import pytest

from devicebus import errors
from eap.errors import ConfigError
from eap.runtime.bus_errors import ErrorRecord, to_error, to_record


@pytest.mark.parametrize(
    ("error", "numbers"),
    [
        (errors.BusError("the cable"), {}),
        (errors.FrameLostError("no frame came back"), {}),
        (
            errors.WorkingCounterError("reading", expected=3, received=1),
            {"expected": 3, "received": 1},
        ),
        (errors.AlStatusError("refuses OP", code=0x1B, state=4), {"code": 0x1B, "state": 4}),
        (errors.MailboxRefusedError("size", detail=8), {"detail": 8}),
        (errors.SoeError("no IDN", code=0x1001), {"code": 0x1001}),
        (errors.FoeError("not found", code=0x8001), {"code": 0x8001, "text": ""}),
        (errors.EoeError("no", result=2), {"result": 2}),
        (errors.StateTimeoutError("still in INIT"), {}),
    ],
)
def test_there_and_back(error, numbers):
    back = to_error(to_record(error))
    assert type(back) is type(error)
    assert str(back) == str(error)
    assert {name: getattr(back, name) for name in numbers} == numbers


def test_others_become_errors_of_the_bus():
    assert to_record(ConfigError("no number")) == ErrorRecord("BusError", "no number")
    for kind in ("EapError", "annotations", "os", ""):
        assert type(to_error(ErrorRecord(kind, "text"))) is errors.BusError


@pytest.mark.parametrize(
    "kind",
    [each for each in vars(errors).values() if isinstance(each, type)],
    ids=lambda k: k.__name__,
)
def test_every_bus_error_has_its_numbers_in_the_table(kind):
    if issubclass(kind, errors.BusError):
        assert type(to_error(ErrorRecord(kind.__name__, "text"))) is kind, (
            f"{kind.__name__}: add its numbers to _FACTS of eap/runtime/bus_errors.py"
        )
